"""Flights from waypoint to waypoint, at rest in each."""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.motion.draws import constant, fold_each, following, phases, points, uav_keys
from coloc_env.motion.fit import half_extents, positive
from coloc_env.motion.frames import heading, unit, yaw_attitude
from coloc_env.motion.timing import MINIMUM_JERK_SPEED, cycles, minimum_jerk, seconds

Point = tuple[float, ...]


@dataclass(frozen=True)
class Waypoints(Motion):
    """Minimum-jerk flights between waypoints, all of one duration, turning at rest in between.

    With ``route`` the team flies one closed route, UAV i ahead by i / N of it; without, every world
    and UAV has its own waypoints, uniform in the room, UAV i ahead by i / N of a leg. Yaw along the
    leg; at rest it turns the short way to the next leg's (a vertical leg of a route has the yaw of
    the leg before it).
    """

    route: tuple[Point, ...] | None = None  # m
    max_speed: float = 3.0  # m/s, never exceeded
    duration: float | None = None  # s a leg; None: the longest possible leg just reaches max_speed
    pause: float = 2.0  # s at rest in each waypoint
    margin: float = 0.5  # m that random waypoints keep from the walls

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "max_speed", "duration", "pause")
        if self.route is not None:
            _check_route(self.route, arena)
        fastest = MINIMUM_JERK_SPEED * self._longest(arena) / self._duration(arena)
        if not fastest <= self.max_speed * (1 + 1e-12):
            least = MINIMUM_JERK_SPEED * self._longest(arena) / self.max_speed
            raise ValueError(
                f"Waypoints: duration = {self.duration:g} s exceeds max_speed = {self.max_speed:g} "
                f"m/s on the longest leg: at least {least:g} s"
            )
        legs = 1 if self.route is None else len(self.route)
        return {
            "keys": uav_keys(keys, arena.n_uavs),
            "legs": legs * phases(keys, arena.n_uavs, arena.n_uavs),
        }

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        flight = self._duration(arena)
        period = flight + self.pause
        leg, fraction = cycles(seconds(steps, arena.dt) / period + carry["legs"].unsqueeze(1))
        if self.route is None:
            start, end, ahead, after = self._random_legs(carry["keys"], leg.long(), arena)
        else:
            start, end, ahead, after = _route_legs(self.route, leg.long())
        truth = leg_flight(start, end, (ahead, after), fraction * period, flight, self.pause)
        return truth, carry

    def _random_legs(
        self, keys: Int64[Tensor, "R N"], leg: Int64[Tensor, "R K N"], arena: Arena
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Start, end, direction and next direction of a leg; waypoint j is drawn from (UAV, j)."""
        low = tuple(a + self.margin for a in arena.low)
        high = tuple(b - self.margin for b in arena.high)
        drawn = points(fold_each(keys, following(leg, 3)), "motion.waypoints", low, high)
        leaps = drawn[1:] - drawn[:2]
        ahead = torch.stack(unit(leaps[..., 0], leaps[..., 1]), -1)
        return drawn[0], drawn[1], ahead[0], ahead[1]

    def _longest(self, arena: Arena) -> float:
        """Length of the longest leg that can come (m)."""
        if self.route is None:
            return 2 * math.hypot(*half_extents(self, arena, self.margin))
        return max(math.dist(a, b) for a, b in _legs(self.route))

    def _duration(self, arena: Arena) -> float:
        if self.duration is not None:
            return self.duration
        return MINIMUM_JERK_SPEED * self._longest(arena) / self.max_speed


def leg_flight(
    start: Float64[Tensor, "R K N d"],
    end: Float64[Tensor, "R K N d"],
    directions: tuple[Float64[Tensor, "R K N 2"], Float64[Tensor, "R K N 2"]],
    time: Float64[Tensor, "R K N"],
    flight: float,
    pause: float,
) -> Kinematics:
    """``time`` s into a minimum-jerk flight of ``flight`` s from point to point and the ``pause``
    after it, in which the yaw turns from this leg's direction to the next one's."""
    covered, rate = minimum_jerk(time / flight)
    turned, _ = minimum_jerk((time - flight) / pause)
    leap = end - start
    return Kinematics(
        start + covered.unsqueeze(-1) * leap,
        (rate / flight).unsqueeze(-1) * leap,
        yaw_attitude(*_turn(*directions, turned), start.shape[-1]),
    )


def _check_route(route: tuple[Point, ...], arena: Arena) -> None:
    if len(set(route)) < 2:
        raise ValueError(f"Waypoints: route needs two different points or more, not {route}")
    for number, point in enumerate(route):
        inside = len(point) == arena.dim and all(
            low <= x <= high for low, x, high in zip(arena.low, point, arena.high, strict=True)
        )
        if not inside:
            raise ValueError(
                f"Waypoints: route[{number}] = {point} does not lie in the arena, "
                f"{arena.low} to {arena.high}"
            )


def _legs(route: tuple[Point, ...]) -> list[tuple[Point, Point]]:
    """The legs of a closed route."""
    return list(zip(route, route[1:] + route[:1], strict=True))


@lru_cache(maxsize=64)
def _directions(route: tuple[Point, ...]) -> tuple[tuple[float, float], ...]:
    """Horizontal direction of each leg; a vertical leg has that of the leg before it."""
    found: list[tuple[float, float] | None] = []
    for a, b in _legs(route):
        length = math.hypot(b[0] - a[0], b[1] - a[1])
        flat = ((b[0] - a[0]) / length, (b[1] - a[1]) / length) if length > 1e-9 else None
        found.append(flat or (found[-1] if found else None))
    last = found[-1] or (1.0, 0.0)
    return tuple(direction or last for direction in found)


def _route_legs(
    route: tuple[Point, ...], leg: Int64[Tensor, "R K N"]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Start, end, direction and next direction of each leg of a closed route."""
    places, ahead = constant(route, leg.device), constant(_directions(route), leg.device)
    this, after = leg.remainder(len(route)), (leg + 1).remainder(len(route))
    return places[this], places[after], ahead[this], ahead[after]


def _turn(
    start: Float64[Tensor, "*s 2"], end: Float64[Tensor, "*s 2"], share: Float64[Tensor, "*s"]
) -> tuple[Float64[Tensor, "*s"], Float64[Tensor, "*s"]]:
    """From one unit direction a share of the short way to another."""
    (a, b), (c, d) = start.unbind(-1), end.unbind(-1)
    angle = share * heading(a * c + b * d, a * d - b * c)
    cosine, sine = angle.cos(), angle.sin()
    return a * cosine - b * sine, b * cosine + a * sine
