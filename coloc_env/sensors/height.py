"""Height above the world's origin, from a downward laser or a barometer."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from coloc_env import noise
from coloc_env.options import Group, Metres, PositiveSeconds, Share
from coloc_env.sensors.base import MASK, Layout, Leaf, Sensor, Window, require
from coloc_env.sensors.errors.persistence import gauss_markov


@dataclass(frozen=True)
class Height(Sensor):
    """Leaves ``height`` [1] and ``height_mask`` [1]: z in m with Gaussian noise ``std``.

    Each UAV's heights have a bias of standard deviation ``bias_std`` m, a Gauss–Markov process
    whose correlation falls by e in ``bias_time`` s; ``estimated``: filters that believe in it have
    it as a state, and do not only consider it.
    """

    std: float = 0.1
    dropout: float = 0.0
    bias_std: float = 0.0
    bias_time: float = 100.0
    estimated: bool = False

    def __post_init__(self) -> None:
        require(self.std >= 0, self, "std", "a standard deviation in m ≥ 0")
        require(0 <= self.dropout <= 1, self, "dropout", "a probability in [0, 1]")
        require(0 <= self.bias_std < math.inf, self, "bias_std", "a standard deviation in m ≥ 0")
        require(0 < self.bias_time < math.inf, self, "bias_time", "a time in s > 0")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        require(layout.arena.dim == 3, "Height", "dim", "a height needs a 3-D scenario")
        return {"height": Leaf(1, unit="m", frame="world"), "height_mask": Leaf(1, *MASK)}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        z = window.motion.position[..., 2:].to(torch.float32)
        n = z.shape[-2]
        mask = window.alive
        if self.dropout:
            mask = mask & (noise.uniform(window.keys, "height.dropout", n) >= self.dropout)
        visible = mask.to(torch.float32).unsqueeze(-1)
        seen = z + self.std * noise.normal(window.keys, "height", n).unsqueeze(-1)
        if self.bias_std:
            uavs = torch.arange(n, device=z.device)
            time, first = self.bias_time / window.layout.arena.dt, window.steps[:, 0]
            drawn = gauss_markov(window.rows, first, z.shape[1], uavs, "height.bias", time)
            seen = seen + self.bias_std * drawn.unsqueeze(-1)
        return {"height": seen * visible, "height_mask": visible}


@dataclass(frozen=True)
class BarometerOptions(Group):
    """With ``barometer``, UAVs measure their height with noise of ``barometer_std`` m and a bias
    that drifts (a Gauss–Markov process of standard deviation ``barometer_drift`` m, whose
    correlation falls by e in ``barometer_time`` s), which filters estimate; a share
    ``barometer_dropout`` is missing."""

    title: ClassVar[str] = "barometer"

    barometer: bool = False
    barometer_std: Metres = 0.1
    barometer_drift: Metres = 0.5
    barometer_time: PositiveSeconds = 300.0
    barometer_dropout: Share = 0.0

    @property
    def true(self) -> tuple[Height, ...]:
        """The sensor as it is; nothing without a barometer."""
        drift = (self.barometer_drift, self.barometer_time)
        own = Height(self.barometer_std, self.barometer_dropout, *drift, estimated=True)
        return (own,) if self.barometer else ()
