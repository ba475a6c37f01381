"""Straight legs back and forth or around a square, with smooth stops where they turn."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.motion.draws import GOLDEN, phases
from coloc_env.motion.fit import altitude, at_most, half_extents, positive
from coloc_env.motion.frames import level_flight
from coloc_env.motion.timing import StopAndGoLaw, alternating, cycles, seconds

_SPEED = 0.5


@dataclass(frozen=True)
class Line(Motion):
    """Parallel lanes along x, back and forth at constant speed; UAVs turn round at rest.

    Lanes are spread evenly over the arena's width, and over its height in a mixed order; UAV i is
    i / N of a round trip ahead: the team is never in one plane. Peak acceleration
    1.875 ``speed`` / ``ramp``.
    """

    speed: float = 0.5  # m/s
    ramp: float = 2.0  # s from rest to speed
    pause: float = 2.0  # s at rest at each end, turning round
    height: float | None = None  # m, of every lane; None: spread over the room
    margin: float = 0.5  # m kept from the walls

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "speed", "ramp", "pause")
        halves = half_extents(self, arena, self.margin)
        at_most(self, "speed", self.speed, 2 * halves[0] / self.ramp, arena)
        share = phases(keys, arena.n_uavs, arena.n_uavs)
        height, spread = altitude(self, arena, self.height), 0.0
        if arena.dim == 3 and self.height is None:
            spread = halves[2]
        mixed = cycles(GOLDEN * arena.n_uavs * share)[1]
        return {
            "legs": 2 * share,
            "y": arena.centre[1] + halves[1] * (2 * share + 1 / arena.n_uavs - 1),
            "z": height + spread * (2 * mixed - 1),
        }

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        length = 2 * half_extents(self, arena, self.margin)[0]
        law = StopAndGoLaw(length / self.speed - self.ramp, self.ramp, self.pause)
        leg, distance, rate, turned = law.at(
            seconds(steps, arena.dt) / law.period + carry["legs"].unsqueeze(1)
        )
        forth = alternating(leg)
        x = arena.centre[0] + forth * (self.speed * distance - 0.5 * length)
        y, z = carry["y"].unsqueeze(1), carry["z"].unsqueeze(1)
        yaw = math.pi * turned
        ahead = forth * yaw.cos(), forth * yaw.sin()
        velocity = (forth * (self.speed * rate), 0.0, 0.0)
        return level_flight((x, y, z), velocity, ahead, arena.dim), carry


@dataclass(frozen=True)
class Square(Motion):
    """An anticlockwise square from its lower left corner; UAV i is i / N of a round ahead.

    UAVs stop at each corner and turn at rest; with ``sharp`` they fly at constant speed and turn at
    once, the square of ``wsn-v0``: at a corner's step the velocity is that of the side ahead.
    """

    side: float | None = None  # m; None: 0.6 of the smaller horizontal side
    corner: tuple[float, float] | None = None  # lower left, m; None: centred
    period: float | None = None  # s a round; None: at 0.5 m/s along the sides
    sharp: bool = False
    ramp: float = 1.0  # s from rest to speed, unless sharp
    pause: float = 1.0  # s at rest in each corner, unless sharp
    height: float | None = None  # m; None: mid-room

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "side", "period", "ramp", "pause")
        side, corner = self._place(arena)
        for axis in (0, 1):
            at_most(self, "side", side, arena.high[axis] - corner[axis], arena)
            if corner[axis] < arena.low[axis]:
                raise ValueError(f"Square: corner {corner} lies outside the arena, {arena.low}")
        altitude(self, arena, self.height)
        needed = 4 * (2 * self.ramp + self.pause)
        if not self.sharp and self._period(side) < needed:
            raise ValueError(
                f"Square: period = {self._period(side):g} s is too short for ramp = {self.ramp:g} "
                f"s and pause = {self.pause:g} s: at least {needed:g} s"
            )
        return {"sides": 4 * phases(keys, arena.n_uavs, arena.n_uavs)}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        side, corner = self._place(arena)
        leg_time = 0.25 * self._period(side)
        turns = seconds(steps, arena.dt) / leg_time + carry["sides"].unsqueeze(1)
        if self.sharp:
            leg, covered = cycles(turns)
            rate, turned = torch.full_like(leg, 1 / leg_time), torch.zeros_like(leg)
        else:
            law = StopAndGoLaw(leg_time - 2 * self.ramp - self.pause, self.ramp, self.pause)
            leg, distance, speed, turned = law.at(turns)
            covered, rate = distance / law.travel, speed / law.travel
        leg = leg - 4 * (0.25 * leg).floor()
        x, y = _around(leg + covered)
        position = (corner[0] + side * x, corner[1] + side * y, altitude(self, arena, self.height))
        pace = side * rate
        east = (leg == 0).double() - (leg == 2).double()
        north = (leg == 1).double() - (leg == 3).double()
        yaw = 0.5 * math.pi * (leg + turned)
        ahead = yaw.cos(), yaw.sin()
        return level_flight(position, (pace * east, pace * north, 0.0), ahead, arena.dim), carry

    def _period(self, side: float) -> float:
        if self.period is not None:
            return self.period
        stops = 0.0 if self.sharp else self.ramp + self.pause
        return 4 * (side / _SPEED + stops)

    def _place(self, arena: Arena) -> tuple[float, tuple[float, float]]:
        """Side and lower left corner (m)."""
        side = 1.2 * min(half_extents(self, arena)[:2]) if self.side is None else self.side
        centred = (arena.centre[0] - 0.5 * side, arena.centre[1] - 0.5 * side)
        return side, centred if self.corner is None else self.corner


def _around(
    q: Float64[Tensor, "R K N"],
) -> tuple[Float64[Tensor, "R K N"], Float64[Tensor, "R K N"]]:
    """The point of the unit square reached after q of its four sides."""
    x = q.clamp(0.0, 1.0) - (q - 2).clamp(0.0, 1.0)
    return x, (q - 1).clamp(0.0, 1.0) - (q - 3).clamp(0.0, 1.0)
