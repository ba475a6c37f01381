"""Odometry: what a vehicle moved and turned over a step, by its wheels or by its cameras."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float32
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import rotation_between, unrotate
from coloc_env.sensors.base import Layout, Leaf, RecordedSensor, Sensor, Window, require


@dataclass(frozen=True)
class Odometry(Sensor):
    """Leaf ``odometry`` [3] or, in space, [6]: displacement forward and left, and up in space (m),
    and turn (rad; a rotation vector in space) over the step that ends now, divided by dt, in the
    body frame at the step's start.

    The noise of one sample has standard deviations ``forward_std`` and ``left_std`` (m/s; the
    latter upwards, too) and ``turn_std`` (rad/s), each plus ``relative`` times the magnitude of
    what it measures.
    """

    may_be_blind = False

    forward_std: float = 0.02
    left_std: float = 0.01
    turn_std: float = 0.02
    relative: float = 0.0

    def __post_init__(self) -> None:
        for name in ("forward_std", "left_std", "turn_std", "relative"):
            require(getattr(self, name) >= 0, self, name, "a standard deviation ≥ 0")

    @classmethod
    def of_steps(cls, noise: tuple[float, float], dt: float) -> Self:
        """With noise in m (each way) and degrees of the motion over steps of ``dt`` s."""
        slip = noise[0] / dt
        return cls(slip, slip, math.radians(noise[1]) / dt)

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        size = 6 if layout.arena.dim == 3 else 3
        return {"odometry": Leaf(size, unit="m/s, rad/s", frame="body")}

    def std(self, odometry: Tensor) -> Tensor:
        """Standard deviations of a sample, as wide as it is; sideways slip follows the speed."""
        dim = 3 if odometry.shape[-1] == 6 else 2
        turns = odometry.shape[-1] - dim
        slips = (self.forward_std, *(self.left_std,) * (dim - 1))
        base = odometry.new_tensor((*slips, *(self.turn_std,) * turns))
        size = odometry.abs()
        speed = size[..., :1].expand(*size.shape[:-1], dim)
        return base + self.relative * torch.cat((speed, size[..., dim:]), -1)

    def turn_rate(self, leaves: Mapping[str, Float32[Tensor, "B N F"]]) -> Float32[Tensor, "B N t"]:
        odometry = leaves["odometry"]
        return odometry[..., 2:] if odometry.shape[-1] == 3 else odometry[..., 3:]

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        now, before, dt = window.motion, window.before, window.layout.arena.dt
        moved = unrotate(before.attitude, now.position - before.position)
        turned = rotation_between(before.attitude, now.attitude)
        clean = (torch.cat((moved, turned), -1) / dt).to(torch.float32)
        n, width = clean.shape[-2:]
        white = noise.normal(window.keys, "odometry", width * n).unflatten(-1, (n, width))
        return {"odometry": (clean + white * self.std(clean)) * window.alive.unsqueeze(-1)}


@dataclass(frozen=True, eq=False)
class RecordedOdometry(RecordedSensor):
    """A recorded ``Odometry`` in the plane that may have one more leaf where samples are missing:

    ``odometry_unknown`` [3]: what the mean over the step is off for want of samples, standard
    deviations forward, left (m/s) and of the turn (rad/s), beside those of ``Odometry.std``.
    """

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        own = super().leaves(layout)
        if "odometry_unknown" in self.series:
            own["odometry_unknown"] = Leaf(3, 0.0, unit="m/s, rad/s", frame="body")
        return own
