"""Closed curves that the whole team flies, UAV i ahead of UAV 0 by its share of a turn."""

import math
from dataclasses import dataclass

from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.motion.draws import phases
from coloc_env.motion.fit import altitude, at_most, half_extents, only_3d, positive
from coloc_env.motion.frames import level_flight, unit
from coloc_env.motion.timing import StopAndGoLaw, alternating, seconds

Pair = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Circle(Motion):
    """Circles about the arena's centre, height swinging once a turn, yaw along the velocity.

    UAV i starts at angle 2π i / N. The radius is ``speed / rate``; the defaults are those of
    ``indoor-v0``: 3.33 m, 1.2 to 1.8 m high.
    """

    speed: float = 0.5  # horizontal, m/s
    rate: float = 0.15  # rad/s
    height: float | None = 1.5  # m; None: mid-room
    height_amplitude: float = 0.3  # m

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "speed", "rate")
        widest = min(half_extents(self, arena)[:2])
        at_most(self, "speed / rate, the radius,", self.speed / self.rate, widest, arena)
        altitude(self, arena, self.height, self.height_amplitude)
        return {"phase": 2 * math.pi * phases(keys, arena.n_uavs, arena.n_uavs)}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        phase = self.rate * seconds(steps, arena.dt) + carry["phase"].unsqueeze(1)
        height = altitude(self, arena, self.height, self.height_amplitude)
        truth = circle(
            phase, self.rate, self.speed / self.rate, arena, height, self.height_amplitude
        )
        return truth, carry


def circle(
    phase: Float64[Tensor, "R K N"],
    rate: float | Float64[Tensor, "R K N"],
    radius: float,
    arena: Arena,
    height: float,
    height_amplitude: float,
) -> Kinematics:
    """Kinematics on a circle about the arena's centre, at an angle (rad) and its rate (rad/s)."""
    cosine, sine = phase.cos(), phase.sin()
    speed = rate * radius
    position = (
        arena.centre[0] + radius * cosine,
        arena.centre[1] + radius * sine,
        height + height_amplitude * sine,
    )
    velocity = (-speed * sine, speed * cosine, rate * height_amplitude * cosine)
    return level_flight(position, velocity, (-sine, cosine), arena.dim)


@dataclass(frozen=True)
class Helix(Motion):
    """A circle that climbs and descends at a constant rate between floor and ceiling (3-D only).

    UAV i is i / N of a turn and of a climb-and-descent ahead. Peak vertical acceleration
    1.875 ``climb`` / ``ramp``.
    """

    speed: float = 0.5  # horizontal, m/s
    radius: float | None = None  # m; None: half of what fits
    climb: float = 0.2  # m/s, up and down
    ramp: float = 2.0  # s to reach the climb rate
    pause: float = 1.0  # s level at the top and at the bottom
    margin: float = 0.5  # m kept from the walls

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "speed", "radius", "climb", "ramp", "pause")
        only_3d(self, arena)
        at_most(self, "radius", self._radius(arena), self._widest(arena), arena)
        rise = 2 * half_extents(self, arena, self.margin)[2]
        at_most(self, "climb", self.climb, rise / self.ramp, arena)
        return {"phase": phases(keys, arena.n_uavs, arena.n_uavs)}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        time, share = seconds(steps, arena.dt), carry["phase"].unsqueeze(1)
        radius = self._radius(arena)
        phase = self.speed / radius * time + 2 * math.pi * share
        cosine, sine = phase.cos(), phase.sin()
        rise = 2 * half_extents(self, arena, self.margin)[2]
        law = StopAndGoLaw(rise / self.climb - self.ramp, self.ramp, self.pause)
        leg, distance, rate, _ = law.at(time / law.period + 2 * share)
        up = alternating(leg)
        position = (
            arena.centre[0] + radius * cosine,
            arena.centre[1] + radius * sine,
            arena.centre[2] + up * (self.climb * distance - 0.5 * rise),
        )
        velocity = (-self.speed * sine, self.speed * cosine, up * (self.climb * rate))
        return level_flight(position, velocity, (-sine, cosine), 3), carry

    def _widest(self, arena: Arena) -> float:
        return min(half_extents(self, arena, self.margin)[:2])

    def _radius(self, arena: Arena) -> float:
        return 0.5 * self._widest(arena) if self.radius is None else self.radius


@dataclass(frozen=True)
class FigureEight(Motion):
    """Gerono's lemniscate x = a sin θ, y = ½ a sin 2θ, height swinging with cos θ.

    ``max_speed`` is reached at the crossing. An even team is spread over N + 1 places, so that no
    two UAVs meet there.
    """

    max_speed: float = 1.0  # horizontal, m/s
    half_length: float | None = None  # a, m; None: what fits
    height: float | None = None  # m; None: mid-room
    height_amplitude: float = 0.3  # m
    margin: float = 0.5  # m kept from the walls

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "max_speed", "half_length")
        at_most(self, "half_length", self._half_length(arena), self._longest(arena), arena)
        altitude(self, arena, self.height, self.height_amplitude)
        places = arena.n_uavs + (arena.n_uavs + 1) % 2
        return {"phase": 2 * math.pi * phases(keys, arena.n_uavs, places)}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        a = self._half_length(arena)
        rate = self.max_speed / (a * math.sqrt(2))
        phase = rate * seconds(steps, arena.dt) + carry["phase"].unsqueeze(1)
        (x, y), level, ahead = lemniscate(phase, rate, a)
        height = altitude(self, arena, self.height, self.height_amplitude)
        position = (
            arena.centre[0] + x,
            arena.centre[1] + y,
            height + self.height_amplitude * phase.cos(),
        )
        velocity = (*level, -rate * self.height_amplitude * phase.sin())
        return level_flight(position, velocity, ahead, arena.dim), carry

    def _longest(self, arena: Arena) -> float:
        x, y = half_extents(self, arena, self.margin)[:2]
        return min(x, 2 * y)

    def _half_length(self, arena: Arena) -> float:
        return self._longest(arena) if self.half_length is None else self.half_length


def lemniscate(
    phase: Float64[Tensor, "R K N"], rate: float | Tensor, a: float | Tensor
) -> tuple[Pair, Pair, Pair]:
    """Position (m) and velocity (m/s) on Gerono's lemniscate about the origin, and the tangent.

    From the angle θ (rad), its rate (rad/s) and the half-length a (m); the unit tangent is that of
    growing θ.
    """
    cosine, sine = phase.cos(), phase.sin()
    double = 1 - 2 * sine * sine  # cos 2θ: with cos θ the tangent, which never vanishes
    position = a * sine, a * sine * cosine
    return position, (rate * a * cosine, rate * a * double), unit(cosine, double)
