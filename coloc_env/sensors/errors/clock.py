"""Clocks that disagree: what is systematically wrong with two-way ranging."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.sensors.base import Window, in_slots, require


@dataclass(frozen=True)
class Clock:
    """A range between UAVs i < j is too long by a_i + a_j + s_i(t) − s_j(t).

    ``offset``: standard deviation in m of a, what calibration has left of each UAV's antenna delay,
    a constant drawn once. ``skew``: amplitude in m of s, from the frequency error e of its crystal:
    i starts the exchange, j replies after T, and the range is off by ½ c T (e_i − e_j). It follows
    the crystal's temperature: a sine whose period is drawn once, between a half and twice
    ``period`` s, so that |s| ≤ ``skew``.

    The defaults are choices: some decimetres of antenna delay left by calibration; 1 ppm left of
    the frequency errors and T = 0.5 ms make 7.5 cm by the formula above (Decawave application note
    APS011, "Sources of error in DW1000 based two-way ranging", on ranging with clock drift).
    """

    offset: float = 0.2
    skew: float = 0.1
    period: float = 300.0

    def __post_init__(self) -> None:
        require(0 <= self.offset < math.inf, self, "offset", "a standard deviation in m ≥ 0")
        require(0 <= self.skew < math.inf, self, "skew", "an amplitude in m ≥ 0")
        require(0 < self.period < math.inf, self, "period", "a time in s > 0")

    def place(self, keys: Int64[Tensor, "R"], n_uavs: int) -> dict[str, Float32[Tensor, "R N"]]:
        """Offset a (m) of each UAV, and rate (rad/s) and phase (rad) of its s."""
        drawn = noise.uniform(keys, "clock.skew", 2 * n_uavs).unflatten(-1, (2, n_uavs))
        return {
            "offset": self.offset * noise.normal(keys, "clock.offset", n_uavs),
            "rate": 2 * math.pi / self.period * 4 ** (drawn[:, 0] - 0.5),
            "phase": 2 * math.pi * drawn[:, 1],
        }

    def errors(
        self, window: Window, steps: Int64[Tensor, "R K"], placed: dict[str, Tensor]
    ) -> Float32[Tensor, "R K N S"]:
        """What is added to the range to each neighbour slot (m), made at ``steps``."""
        time = steps.to(torch.float32).unsqueeze(-1) * window.layout.arena.dt
        skew = (placed["rate"].unsqueeze(1) * time).add_(placed["phase"].unsqueeze(1)).sin_()
        skew = self.skew * skew
        offset = placed["offset"].unsqueeze(1).expand_as(skew)
        own = torch.arange(skew.shape[-1], device=steps.device).unsqueeze(-1)
        first = 2.0 * (own < window.neighbours).to(torch.float32) - 1.0
        theirs, ahead = (in_slots(x, window.neighbours) for x in (offset, skew))
        return (offset.unsqueeze(-1) + theirs) + first * (skew.unsqueeze(-1) - ahead)
