"""The frame that relative estimates are stated in."""

from dataclasses import dataclass

import torch
from torch import Tensor

from coloc_env.geometry import poses_in
from coloc_env.sensors.base import Layout, Leaf, Sensor, Window


@dataclass(frozen=True)
class Reference(Sensor):
    """Leaf ``reference`` [P]: the true pose of UAV 0 in the world frame, the same for every UAV:
    position (m), then quaternion wxyz or heading (rad).

    Where a team measures nothing but poses relative to each other, no estimate can state where
    in the world it is. This leaf defines the world frame, so that a pose relative to UAV 0 can
    be stated, and scored, in it. It is a convention, no measurement: a localizer that took UAV 0's
    motion from it would know more than its sensors measure.
    """

    may_be_blind = False
    informs = False

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        unit = "m, quaternion" if layout.arena.dim == 3 else "m, rad"
        return {"reference": Leaf(poses_in(layout.arena.dim).size, unit=unit, frame="world")}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        motion = window.motion
        pose = torch.cat((motion.position[:, :, :1], motion.attitude[:, :, :1]), -1)
        pose = pose.to(torch.float32).expand(-1, -1, window.layout.arena.n_uavs, -1)
        return {"reference": pose * window.alive.unsqueeze(-1)}
