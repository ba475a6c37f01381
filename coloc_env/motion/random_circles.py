"""A circle of its own for every world and UAV: no policy can learn the path by heart."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.motion.draws import uav_keys, uniform
from coloc_env.motion.fit import at_most, half_extents, interval
from coloc_env.motion.frames import level_flight
from coloc_env.motion.timing import seconds


@dataclass(frozen=True)
class RandomCircles(Motion):
    """Circles whose centre, radius, direction, phase, height, swing and speed are drawn uniformly.

    Drawn per world and UAV, such that the circle keeps a margin from the walls. The height swings
    once a turn with a phase of its own; yaw along the velocity.
    """

    speed: tuple[float, float] = (0.2, 1.0)  # horizontal, m/s
    radius: tuple[float, float] | None = None  # m; None: a quarter to all of what fits
    height_amplitude: tuple[float, float] = (0.0, 0.5)  # m
    margin: float = 0.5  # m kept from the walls

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        halves = half_extents(self, arena, self.margin)
        u = uniform(uav_keys(keys, arena.n_uavs), "motion.random", 9).unbind(-1)
        radius = _between(u[0], self._radius(halves, arena))
        rate = torch.copysign(_between(u[1], interval(self, "speed")) / radius, u[2] - 0.5)
        drawn = [
            arena.centre[0] + (halves[0] - radius) * (2 * u[3] - 1),
            arena.centre[1] + (halves[1] - radius) * (2 * u[4] - 1),
            radius,
            rate,
            2 * math.pi * u[5],
        ]
        if arena.dim == 3:
            swings = interval(self, "height_amplitude", zero=True)
            at_most(self, "height_amplitude[1]", swings[1], halves[2], arena)
            swing, delay = _between(u[6], swings), 2 * math.pi * u[7]
            drawn.append(arena.centre[2] + (halves[2] - swing) * (2 * u[8] - 1))
            drawn += [swing * delay.cos(), swing * delay.sin()]
        return {"circle": torch.stack(drawn, 1)}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        x, y, radius, rate, phase, *upright = carry["circle"].unsqueeze(2).unbind(1)
        angle = rate * seconds(steps, arena.dt) + phase
        cosine, sine = angle.cos(), angle.sin()
        speed, sense = rate * radius, rate.sign()
        position = [x + radius * cosine, y + radius * sine]
        velocity = [-speed * sine, speed * cosine]
        if upright:
            z, in_phase, in_quadrature = upright
            position.append(z + (in_phase * sine + in_quadrature * cosine))
            velocity.append(rate * (in_phase * cosine - in_quadrature * sine))
        return level_flight(position, velocity, (-sense * sine, sense * cosine), arena.dim), carry

    def _radius(self, halves: tuple[float, ...], arena: Arena) -> tuple[float, float]:
        widest = min(halves[:2])
        if self.radius is None:
            return 0.25 * widest, widest
        small, large = interval(self, "radius")
        return small, at_most(self, "radius[1]", large, widest, arena)


def _between(u: Tensor, limits: tuple[float, float]) -> Tensor:
    return limits[0] + (limits[1] - limits[0]) * u
