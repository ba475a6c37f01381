"""Velocity over ground in the body's own axes, from a camera that looks down."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import unrotate
from coloc_env.options import Group, Metres, PositiveMetres, Share, Speed
from coloc_env.sensors.base import MASK, Layout, Leaf, Sensor, Window, require


@dataclass(frozen=True)
class OpticalFlow(Sensor):
    """Leaves ``flow`` [2] and ``flow_mask`` [1]: velocity forward and left in m/s, body frame, with
    Gaussian noise ``std`` per axis.

    Nothing below ``lowest`` or above ``highest`` m (none: no limit) over the floor, z = 0, where a
    camera is out of focus or resolves nothing. A share ``dropout`` is missing.
    """

    std: float = 0.1
    lowest: float = 0.0
    highest: float | None = None
    dropout: float = 0.0

    def __post_init__(self) -> None:
        require(0 <= self.std < math.inf, self, "std", "a standard deviation in m/s ≥ 0")
        require(0 <= self.lowest < math.inf, self, "lowest", "a height in m ≥ 0")
        above = self.highest is None or self.highest > self.lowest
        require(above, self, "highest", f"a height in m above lowest={self.lowest:g}")
        require(0 <= self.dropout <= 1, self, "dropout", "a probability in [0, 1]")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        require(layout.arena.dim == 3, "OpticalFlow", "dim", "looking down needs a 3-D scenario")
        return {"flow": Leaf(2, unit="m/s", frame="body"), "flow_mask": Leaf(1, *MASK)}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        motion = window.motion
        velocity = unrotate(motion.attitude, motion.velocity)[..., :2].to(torch.float32)
        height, n = motion.position[..., 2], velocity.shape[-2]
        seen = window.alive & (height >= self.lowest)
        if self.highest is not None:
            seen = seen & (height <= self.highest)
        if self.dropout:
            seen = seen & (noise.uniform(window.keys, "flow.dropout", n) >= self.dropout)
        white = noise.normal(window.keys, "flow", 2 * n).unflatten(-1, (n, 2))
        mask = seen.to(torch.float32).unsqueeze(-1)
        return {"flow": (velocity + self.std * white) * mask, "flow_mask": mask}


@dataclass(frozen=True)
class FlowOptions(Group):
    """With ``flow``, UAVs measure their velocity forward and left (body frame) with noise of
    ``flow_std`` m/s, from ``flow_lowest`` to ``flow_highest`` m above the floor (none: no limit); a
    share ``flow_dropout`` is missing."""

    title: ClassVar[str] = "optical flow"

    flow: bool = False
    flow_std: Speed = 0.1
    flow_lowest: Metres = 0.0
    flow_highest: PositiveMetres | None = None
    flow_dropout: Share = 0.0

    @property
    def true(self) -> tuple[OpticalFlow, ...]:
        """The sensor as it is; nothing without flow."""
        own = (self.flow_std, self.flow_lowest, self.flow_highest, self.flow_dropout)
        return (OpticalFlow(*own),) if self.flow else ()
