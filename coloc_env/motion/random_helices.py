"""A helix of its own for every world and UAV, between the floor and the ceiling."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.motion.boxes import assigned, reflected, rooms, walls
from coloc_env.motion.draws import between, uav_keys, uniform
from coloc_env.motion.fit import interval, only_3d
from coloc_env.motion.random_circles import RandomCircles
from coloc_env.motion.timing import seconds


@dataclass(frozen=True)
class RandomHelices(Motion):
    """Random circles that climb or descend at a constant rate, reflected near floor and ceiling.

    The rate is drawn uniformly per world and UAV, and its sign; the height stays ``circles.margin``
    from the floor and the ceiling of the UAV's box (3-D only). The vertical velocity jumps where it
    is reflected. The largest speed is √(speed² + climb²).
    """

    circles: RandomCircles = field(default_factory=lambda: RandomCircles(height_amplitude=(0, 0)))
    climb: tuple[float, float] = (0.05, 0.3)  # m/s, up and down

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        only_3d(self, arena)
        carry, own = self.circles.start(keys, arena), uav_keys(keys, arena.n_uavs)
        spaces = rooms(self.circles.boxes, arena)
        low, high = walls(spaces, assigned(spaces, own))
        u = uniform(own, "motion.climb", 2)
        rate = torch.copysign(between(u[..., 0], *interval(self, "climb")), u[..., 1] - 0.5)
        floor, ceiling = low[..., 2] + self.circles.margin, high[..., 2] - self.circles.margin
        return {**carry, "climb": torch.stack((rate, floor, ceiling), 1)}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        truth, _ = self.circles.advance(carry, steps, arena)
        rate, floor, ceiling = carry["climb"].unsqueeze(2).unbind(1)
        climbed = truth.position[..., 2] + rate * seconds(steps, arena.dt)
        height, sense = reflected(floor, ceiling, climbed)
        position, velocity = truth.position.clone(), truth.velocity.clone()
        position[..., 2] = height
        velocity[..., 2] = sense * (velocity[..., 2] + rate)
        return Kinematics(position, velocity, truth.attitude), carry
