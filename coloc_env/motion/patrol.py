"""Patrols between stations, pseudo-random but never across what lies between them."""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Box, Carry, Kinematics, Motion
from coloc_env.motion.draws import constant, fold_each, following, phases, uav_keys, uniform
from coloc_env.motion.fit import inside, positive
from coloc_env.motion.frames import unit
from coloc_env.motion.timing import MINIMUM_JERK_SPEED, cycles, seconds
from coloc_env.motion.waypoints import leg_flight


@dataclass(frozen=True)
class Patrol(Motion):
    """Minimum-jerk flights, all of one duration, between points in boxes, with a rest in each.

    A round visits the ``stations`` (boxes, m) that one of ``routes`` numbers, drawn for every
    UAV and round; all routes are equally long. The point in a station is drawn for every
    visit. UAVs start spread over a round and take no notice of each other. Legs are straight, so
    what lies beyond a plane from both of a leg's stations is never crossed. Yaw along the leg; it
    turns at rest.
    """

    stations: tuple[Box, ...]
    routes: tuple[tuple[int, ...], ...]
    max_speed: float = 8.0  # m/s, which the longest possible leg just reaches
    pause: float = 4.0  # s at rest in each point

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "max_speed", "pause")
        inside(self, "stations", self.stations, arena)
        known = all(0 <= number < len(self.stations) for route in self.routes for number in route)
        if len({len(route) for route in self.routes}) != 1 or not self.routes[0] or not known:
            raise ValueError(
                f"Patrol: routes = {self.routes} must be equally long lists of station numbers "
                f"from 0 to {len(self.stations) - 1}"
            )
        start = uniform(keys, "motion.patrol.begun", 1) + phases(keys, arena.n_uavs, arena.n_uavs)
        return {"keys": uav_keys(keys, arena.n_uavs), "legs": len(self.routes[0]) * start}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        flight = MINIMUM_JERK_SPEED * self._longest() / self.max_speed
        period = flight + self.pause
        leg, fraction = cycles(seconds(steps, arena.dt) / period + carry["legs"].unsqueeze(1))
        points = self._points(carry["keys"], following(leg.long(), 3))
        leaps = points[1:] - points[:2]
        this, after = torch.stack(unit(leaps[..., 0], leaps[..., 1]), -1)
        time = fraction * period
        return leg_flight(points[0], points[1], (this, after), time, flight, self.pause), carry

    def _points(
        self, keys: Int64[Tensor, "R N"], visit: Int64[Tensor, "m R K N"]
    ) -> Float64[Tensor, "m R K N d"]:
        """Where each numbered visit is paid (m)."""
        length = len(self.routes[0])
        drawn = uniform(
            fold_each(keys, visit.div(length, rounding_mode="floor")), "motion.route", 1
        )
        route = (drawn[..., 0] * len(self.routes)).long()
        table = torch.tensor(self.routes, device=keys.device)
        low, high = constant(self.stations, keys.device).unbind(1)
        station = table[route, visit.remainder(length)]
        share = uniform(fold_each(keys, visit), "motion.patrol", low.shape[1])
        return low[station] + (high - low)[station] * share

    def _longest(self) -> float:
        """Length of the longest leg that can come (m)."""
        ends = {route[0] for route in self.routes}
        pairs = {(route[-1], first) for route in self.routes for first in ends}
        pairs |= {pair for route in self.routes for pair in pairwise(route)}
        return max(_farthest(self.stations[a], self.stations[b]) for a, b in pairs)


def _farthest(a: Box, b: Box) -> float:
    """The largest distance between points of two boxes (m)."""
    sides = zip(a[0], a[1], b[0], b[1], strict=True)
    return math.hypot(*(max(a1 - b0, b1 - a0) for a0, a1, b0, b1 in sides))
