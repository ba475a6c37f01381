"""Motion on two scales: fast transit between places, and a slow round at each."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.motion.draws import fold_each, following, phases, points, uav_keys
from coloc_env.motion.fit import half_extents, positive
from coloc_env.motion.frames import columns, unit, yaw_attitude
from coloc_env.motion.timing import MINIMUM_JERK_SPEED, StopAndGoLaw, cycles, seconds
from coloc_env.motion.waypoints import leg_flight


@dataclass(frozen=True)
class Inspection(Motion):
    """Minimum-jerk flights between places at random, in each of which a UAV goes slowly round a
    circle of ``radius`` before it turns at rest and leaves for the next.

    Every world and UAV has its own places, uniform in the room, UAV i ahead by i / N of a period.
    The transit takes so long that the longest possible leg just reaches ``max_speed``. The round is
    a left turn from the direction of arrival back to it, at ``slow_speed`` with ramps of ``ramp``
    s, yaw along it. Heights stay the same while a UAV goes round.
    """

    max_speed: float = 4.5  # m/s, in transit
    slow_speed: float = 0.25  # m/s, going round
    radius: float = 0.5  # m, of the round
    ramp: float = 1.0  # s from rest to slow speed
    pause: float = 2.0  # s at rest, turning to the next leg
    margin: float = 0.5  # m kept from the walls

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "max_speed", "slow_speed", "radius", "ramp", "pause")
        half_extents(self, arena, self.margin)
        half_extents(self, _flat(arena), self._aside)
        if 2 * math.pi * self.radius < self.slow_speed * self.ramp:
            raise ValueError(
                f"Inspection: radius = {self.radius:g} m is too small for slow_speed = "
                f"{self.slow_speed:g} m/s and ramp = {self.ramp:g} s: at least "
                f"{self.slow_speed * self.ramp / (2 * math.pi):g} m"
            )
        return {
            "keys": uav_keys(keys, arena.n_uavs),
            "legs": phases(keys, arena.n_uavs, arena.n_uavs),
        }

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        low, high = self._box(arena)
        flight = MINIMUM_JERK_SPEED * math.dist(low, high) / self.max_speed
        law = StopAndGoLaw(
            2 * math.pi * self.radius / self.slow_speed - self.ramp, self.ramp, self.pause
        )
        period = flight + law.period
        leg, fraction = cycles(seconds(steps, arena.dt) / period + carry["legs"].unsqueeze(1))
        visits = fold_each(carry["keys"], following(leg.long(), 3))
        places = points(visits, "motion.inspection", low, high)
        leaps = places[1:] - places[:2]
        ahead = torch.stack(unit(leaps[..., 0], leaps[..., 1]), -1)
        time = fraction * period
        around = law.period - self.pause
        # The flight and the turn at rest without the round between them, then the round.
        still = time - (time - flight).clamp(0.0, around)
        path = leg_flight(places[0], places[1], (ahead[0], ahead[1]), still, flight, self.pause)
        _, covered, rate, _ = law.at((time - flight).clamp(0.0, around) / law.period)
        angle = covered * (self.slow_speed / self.radius)
        speed = rate * self.slow_speed
        rounding = (time > flight) & (time < flight + around)
        cosine, sine = angle.cos(), angle.sin()
        (x, y), dim = ahead[0].unbind(-1), arena.dim
        # Along the arrival's direction and to its left: r (sin θ, 1 − cos θ), heading θ.
        along, left = self.radius * sine, self.radius * (1 - cosine)
        heading = (x * cosine - y * sine, y * cosine + x * sine)
        level = (0.0,) * (dim - 2)
        moved = columns((along * x - left * y, along * y + left * x, *level), x)
        pace = columns((speed * heading[0], speed * heading[1], *level), x)
        there = rounding.unsqueeze(-1)
        return Kinematics(
            torch.where(there, path.position + moved, path.position),
            torch.where(there, pace, path.velocity),
            torch.where(there, yaw_attitude(*heading, dim), path.attitude),
        ), carry

    @property
    def _aside(self) -> float:
        """What places keep from the walls at their sides (m), so that a round fits."""
        return self.margin + 2 * self.radius

    def _box(self, arena: Arena) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lowest and highest corner (m) of where places are."""
        kept = (self._aside, self._aside, self.margin)[: arena.dim]
        low = tuple(a + side for a, side in zip(arena.low, kept, strict=True))
        return low, tuple(b - side for b, side in zip(arena.high, kept, strict=True))


def _flat(arena: Arena) -> Arena:
    """The arena seen from above."""
    return Arena(2, arena.n_uavs, arena.dt, arena.low[:2], arena.high[:2])
