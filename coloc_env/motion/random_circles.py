"""A circle of its own for every world and UAV: no policy can learn the path by heart."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.motion.base import Arena, Box, Carry, Kinematics, Motion
from coloc_env.motion.boxes import assigned, of_each, rooms
from coloc_env.motion.draws import between, uav_keys, uniform
from coloc_env.motion.fit import at_most, half_extents, inside, interval
from coloc_env.motion.frames import level_flight
from coloc_env.motion.timing import seconds

_DRAWS = 64  # of a circle that is to be clear of walls


@dataclass(frozen=True)
class RandomCircles(Motion):
    """Circles whose centre, radius, direction, phase, height, swing and speed are drawn uniformly.

    Drawn per world and UAV, such that the circle keeps a margin from the walls. The height swings
    once a turn with a phase of its own; yaw along the velocity. ``boxes``: each UAV circles in one
    of these instead of the whole arena; which one is drawn in proportion to their volumes.
    ``walls``: solid boxes, seen from above; a circle that comes nearer than ``clearance`` to one is
    drawn again, up to 63 times, and then the one farthest from them is taken.
    """

    speed: tuple[float, float] = (0.2, 1.0)  # horizontal, m/s
    radius: tuple[float, float] | None = None  # m; None: a quarter to all of what fits
    height_amplitude: tuple[float, float] = (0.0, 0.5)  # m
    margin: float = 0.5  # m kept from the walls
    boxes: tuple[Box, ...] = ()
    walls: tuple[Box, ...] = ()
    clearance: float = 0.3  # m

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        inside(self, "boxes", self.boxes, arena)
        spaces, own = rooms(self.boxes, arena), uav_keys(keys, arena.n_uavs)
        circle = self._drawn(own, spaces, arena)
        if not self.walls:
            return {"circle": circle}
        free = self._free(circle)
        for again in range(1, _DRAWS):
            other = self._drawn(noise.fold(own, again), spaces, arena)
            there = self._free(other)
            better = (free < self.clearance) & (there > free)
            circle = torch.where(better.unsqueeze(1), other, circle)
            free = torch.where(better, there, free)
        return {"circle": circle}

    def _drawn(
        self, own: Int64[Tensor, "R N"], spaces: tuple[Arena, ...], arena: Arena
    ) -> Float64[Tensor, "R c N"]:
        """A circle for each key: centre, radius, rate, phase; height, swing in phase and across."""
        room = assigned(spaces, own)
        extents = tuple(half_extents(self, space, self.margin) for space in spaces)
        centre, halves = of_each(room, (space.centre for space in spaces)), of_each(room, extents)
        u = uniform(own, "motion.random", 9).unbind(-1)
        radius = between(u[0], *of_each(room, map(self._radius, extents, spaces)))
        rate = torch.copysign(between(u[1], *interval(self, "speed")) / radius, u[2] - 0.5)
        drawn = [
            centre[0] + (halves[0] - radius) * (2 * u[3] - 1),
            centre[1] + (halves[1] - radius) * (2 * u[4] - 1),
            radius,
            rate,
            2 * math.pi * u[5],
        ]
        if arena.dim == 3:
            swings = interval(self, "height_amplitude", zero=True)
            for extent, space in zip(extents, spaces, strict=True):
                at_most(self, "height_amplitude[1]", swings[1], extent[2], space)
            swing, delay = between(u[6], *swings), 2 * math.pi * u[7]
            drawn.append(centre[2] + (halves[2] - swing) * (2 * u[8] - 1))
            drawn += [swing * delay.cos(), swing * delay.sin()]
        return torch.stack(drawn, 1)

    def _free(self, circle: Float64[Tensor, "R c N"]) -> Float64[Tensor, "R N"]:
        """How far (m) each circle is from the nearest wall, seen from above; ≤ 0 where it cuts
        one: where its radius is among the distances from its centre to the wall's points."""
        x, y, radius = circle[:, 0], circle[:, 1], circle[:, 2]
        free = torch.full_like(radius, torch.inf)
        for low, high in self.walls:
            sides = zip((x, y), low[:2], high[:2], strict=True)
            away = [(torch.maximum(a - c, c - b).clamp_min(0.0), c - a, b - c) for c, a, b in sides]
            nearest = sum(out * out for out, _, _ in away) ** 0.5
            farthest = sum(torch.maximum(p.abs(), q.abs()) ** 2 for _, p, q in away) ** 0.5
            free = torch.minimum(free, torch.maximum(nearest - radius, radius - farthest))
        return free

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
