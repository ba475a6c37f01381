"""Wheel odometry of a ground robot in the plane."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float32
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import rotation_between, unrotate
from coloc_env.sensors.base import Layout, Leaf, Sensor, Window, require


@dataclass(frozen=True)
class Odometry(Sensor):
    """Leaf ``odometry`` [3]: displacement forward and left (m) and turn (rad) over the step that
    ends now, divided by dt, in the body frame at the step's start.

    The noise of one sample has standard deviations ``forward_std`` and ``left_std`` (m/s) and
    ``turn_std`` (rad/s), each plus ``relative`` times the magnitude of what it measures.
    """

    forward_std: float = 0.02
    left_std: float = 0.01
    turn_std: float = 0.02
    relative: float = 0.0

    def __post_init__(self) -> None:
        for name in ("forward_std", "left_std", "turn_std", "relative"):
            require(getattr(self, name) >= 0, self, name, "a standard deviation ≥ 0")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        require(layout.arena.dim == 2, "Odometry", "dim", "odometry needs a 2-D scenario")
        return {"odometry": Leaf(3)}

    def std(self, odometry: Tensor) -> Tensor:
        """Standard deviations [..., 3] of a sample [..., 3]; sideways slip follows the speed."""
        base = odometry.new_tensor((self.forward_std, self.left_std, self.turn_std))
        size = odometry.abs()
        speed = size[..., :1]
        return base + self.relative * torch.cat((speed, speed, size[..., 2:]), -1)

    def turn_rate(self, leaves: Mapping[str, Float32[Tensor, "B N F"]]) -> Float32[Tensor, "B N t"]:
        return leaves["odometry"][..., 2:]

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        now, before, dt = window.motion, window.before, window.layout.arena.dt
        moved = unrotate(before.attitude, now.position - before.position)
        turned = rotation_between(before.attitude, now.attitude)
        clean = (torch.cat((moved, turned), -1) / dt).to(torch.float32)
        white = noise.normal(window.keys, "odometry", 3 * clean.shape[-2]).unflatten(-1, (-1, 3))
        return {"odometry": (clean + white * self.std(clean)) * window.alive.unsqueeze(-1)}
