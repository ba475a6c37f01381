"""Straight legs flown back and forth or around a square, with smooth stops where they turn."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.motion.draws import phases
from coloc_env.motion.fit import altitude, at_most, half_extents, positive
from coloc_env.motion.frames import level_flight
from coloc_env.motion.timing import StopAndGoLaw, alternating, cycles, seconds

_GOLDEN = 0.5 * (math.sqrt(5) - 1)


@dataclass(frozen=True)
class Line(Motion):
    """Parallel lanes along x, flown back and forth at constant speed; UAVs turn round at rest.

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
        altitude(self, arena, self.height)
        share = phases(keys, arena.n_uavs, arena.n_uavs)
        across = arena.centre[1] + halves[1] * (2 * share + 1 / arena.n_uavs - 1)
        carry = {"legs": 2 * share, "y": across}
        if arena.dim == 3:
            mixed = cycles(_GOLDEN * arena.n_uavs * share)[1]
            spread = arena.centre[2] + halves[2] * (2 * mixed - 1)
            carry["z"] = spread if self.height is None else torch.full_like(spread, self.height)
        return carry

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
        position = (x, *(carry[axis].unsqueeze(1) for axis in "yz"[: arena.dim - 1]))
        velocity = (forth * (self.speed * rate), *(0.0, 0.0)[: arena.dim - 1])
        yaw = math.pi * turned
        return level_flight(position, velocity, (forth * yaw.cos(), forth * yaw.sin())), carry


@dataclass(frozen=True)
class Square(Motion):
    """An anticlockwise square from its lower left corner; UAV i is i / N of a round ahead.

    UAVs stop at each corner and turn at rest; with ``sharp`` they fly at constant speed and turn at
    once, the square of ``wsn-v0``: at a corner's step the velocity is that of the side ahead.
    """

    side: float | None = None  # m; None: 0.6 of the smaller horizontal side
    corner: tuple[float, float] | None = None  # lower left, m; None: centred
    period: float = 40.0  # s a round
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
        if not self.sharp and self._law().cruise < 0:
            needed = 4 * (2 * self.ramp + self.pause)
            raise ValueError(
                f"Square: period = {self.period:g} s is too short for ramp = {self.ramp:g} s and "
                f"pause = {self.pause:g} s: at least {needed:g} s"
            )
        return {"sides": 4 * phases(keys, arena.n_uavs, arena.n_uavs)}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        side, corner = self._place(arena)
        turns = 4 / self.period * seconds(steps, arena.dt) + carry["sides"].unsqueeze(1)
        if self.sharp:
            leg, covered = cycles(turns)
            rate, yaw = 4 / self.period, 0.5 * math.pi * leg
        else:
            law = self._law()
            leg, distance, speed, turned = law.at(turns)
            covered, rate = distance / law.travel, speed / law.travel
            yaw = 0.5 * math.pi * (leg + turned)
        leg = leg - 4 * (0.25 * leg).floor()
        x, y = _around(leg + covered)
        position = [corner[0] + side * x, corner[1] + side * y, altitude(self, arena, self.height)]
        pace = side * rate
        east = (leg == 0).double() - (leg == 2).double()
        north = (leg == 1).double() - (leg == 3).double()
        velocity = [pace * east, pace * north, 0.0]
        position, velocity = position[: arena.dim], velocity[: arena.dim]
        return level_flight(position, velocity, (yaw.cos(), yaw.sin())), carry

    def _law(self) -> StopAndGoLaw:
        cruise = 0.25 * self.period - 2 * self.ramp - self.pause
        return StopAndGoLaw(cruise, self.ramp, self.pause)

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
