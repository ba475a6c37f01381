"""Fixes of a UAV's own position, as satellite navigation gives them."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from coloc_env import noise
from coloc_env.options import Group, Metres, Share
from coloc_env.sensors.base import MASK, Layout, Leaf, Sensor, Window, require


@dataclass(frozen=True)
class PositionFix(Sensor):
    """Leaves ``position_fix`` [d] and ``position_fix_mask`` [1]: position in m, world frame, with
    Gaussian noise ``std`` per axis, of the first ``count`` UAVs; the others never have one."""

    std: float = 1.0
    count: int = 1

    def __post_init__(self) -> None:
        require(self.std >= 0, self, "std", "a standard deviation in m ≥ 0")
        require(self.count >= 1, self, "count", "at least one UAV (leave the sensor out for 0)")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {
            "position_fix": Leaf(layout.arena.dim, unit="m", frame="world"),
            "position_fix_mask": Leaf(1, *MASK),
        }

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        position = window.motion.position.to(torch.float32)
        n, dim = position.shape[-2:]
        white = noise.normal(window.keys, "position_fix", n * dim).unflatten(-1, (n, dim))
        having = window.alive & (torch.arange(n, device=position.device) < self.count)
        mask = having.to(torch.float32).unsqueeze(-1)
        return {
            "position_fix": (position + self.std * white) * mask,
            "position_fix_mask": mask,
        }


@dataclass(frozen=True)
class AnchorUavOptions(Group):
    """A share ``anchor_share`` of the UAVs, the first ones, know where they are, to ``anchor_std``
    m per axis, and are not scored."""

    title: ClassVar[str] = "anchor UAVs"

    anchor_share: Share = 0.15
    anchor_std: Metres = 0.1

    def count(self, n_uavs: int) -> int:
        """How many of a team they are."""
        return round(self.anchor_share * n_uavs)

    def fixes(self, n_uavs: int) -> tuple[PositionFix, ...]:
        """The sensor by which they know where they are; nothing if there are none."""
        count = self.count(n_uavs)
        return (PositionFix(self.anchor_std, count),) if count else ()
