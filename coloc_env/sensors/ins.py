"""Inertial navigation system: velocity in the world frame, with a slowly wandering bias."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.options import Group, PositiveSeconds, Speed
from coloc_env.sensors.base import Layout, Leaf, Sensor, Window, require

_COSINES = 32  # in the sum that makes a bias: its excess kurtosis is −1.5 over their number


@dataclass(frozen=True)
class Ins(Sensor):
    """Leaf ``ins`` [d]: velocity in m/s, world frame.

    Each sample is the *mean over the step that ends now*, so that without noise the samples add up
    to the path exactly. At step 0 no step has passed: the sample is 0.

    ``std``: white noise of one sample (m/s, per axis). ``bias``: standard deviation (m/s) of a bias
    that is a stationary first-order Gauss–Markov process with time constant ``bias_time`` s, one
    for each UAV and axis: correlation exp(−|t| / ``bias_time``).

    A recursion would make a step's bias depend on the steps before it. So each bias is a sum of
    cosines whose frequencies and phases are drawn once, at reset, which gives it at any step
    (spectral sampling: Shinozuka & Deodatis, Applied Mechanics Reviews 44(4), 1991). Frequencies
    drawn from the process's spectrum, a Cauchy distribution, make variance and correlation exact
    over many draws; the sum of many is as good as Gaussian.
    """

    may_be_blind = False

    std: float = 0.5
    bias: float = 0.0
    bias_time: float = 60.0

    def __post_init__(self) -> None:
        for name in ("std", "bias"):
            require(getattr(self, name) >= 0, self, name, "a standard deviation in m/s ≥ 0")
        require(self.bias_time > 0, self, "bias_time", "a time in s > 0")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {"ins": Leaf(layout.arena.dim, unit="m/s", frame="world")}

    def place(self, keys: Int64[Tensor, "R"], layout: Layout) -> dict[str, Tensor]:
        """``turn`` (rad per step) and ``phase`` (rad) of each cosine, [R, cosines, N, d]."""
        if not self.bias:
            return {}
        arena = layout.arena
        each = (2, _COSINES, arena.n_uavs, arena.dim)
        drawn = noise.uniform(keys, "ins.bias", math.prod(each)).double().unflatten(-1, each)
        rate = torch.tan(math.pi * (drawn[:, 0] - 0.5)) / self.bias_time
        turn = torch.remainder(rate * arena.dt + math.pi, 2 * math.pi) - math.pi  # as far as shows
        phase = 2 * math.pi * drawn[:, 1]
        return {"turn": turn.to(torch.float32), "phase": phase.to(torch.float32)}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        now, before, dt = window.motion, window.before, window.layout.arena.dt
        clean = ((now.position - before.position) / dt).to(torch.float32)
        n, dim = clean.shape[-2:]
        white = noise.normal(window.keys, "ins", n * dim).unflatten(-1, (n, dim))
        ins = white.mul_(self.std).add_(clean)
        if placed:
            ins.add_(self._biases(window, placed))
        moved = window.alive & (window.steps > 0).unsqueeze(-1)
        return {"ins": ins.mul_(moved.unsqueeze(-1))}

    def _biases(self, window: Window, placed: dict[str, Tensor]) -> Float32[Tensor, "R K N d"]:
        """The biases at the window's steps."""
        steps = window.steps[..., None, None].to(torch.float32)
        total = steps.new_zeros(())
        waves = (placed[name].unbind(1) for name in ("turn", "phase"))
        for turn, phase in zip(*waves, strict=True):
            angle = (steps * turn.unsqueeze(1)).add_(phase.unsqueeze(1))
            total = total + angle.cos_()
        return total * (self.bias * (2 / _COSINES) ** 0.5)


@dataclass(frozen=True)
class InsOptions(Group):
    """The INS measures the velocity with white noise of ``ins_std`` m/s per axis and step and a
    bias of ``ins_bias`` m/s that wanders over ``ins_bias_time`` s; the team knows both."""

    title: ClassVar[str] = "INS"

    ins_std: Speed = 0.5
    ins_bias: Speed = 0.3
    ins_bias_time: PositiveSeconds = 60.0

    @property
    def sensor(self) -> Ins:
        """The sensor, as it is and as the team believes."""
        return Ins(self.ins_std, self.ins_bias, self.ins_bias_time)
