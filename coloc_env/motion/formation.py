"""A team in formation that changes shape as it goes."""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.motion.draws import constant
from coloc_env.motion.fit import altitude, at_most, half_extents, positive
from coloc_env.motion.frames import level_flight
from coloc_env.motion.timing import cycles, minimum_jerk, seconds

Shape = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class FormationChange(Motion):
    """A formation on a circle about the arena's centre, heading along it, that changes shape.

    Every ``period`` seconds the team blends to the next of ``shapes``, minimum-jerk, during the
    period's last ``blend`` seconds. All UAVs fly at one height with the formation's heading. They
    are numbered from its right to its left, so no two meet in a blend from or to a line or vee.
    Peak speed ``speed`` (1 + size / radius) + 3.75 size / ``blend``.
    """

    shapes: tuple[str, ...] = ("line", "ring", "vee", "grid")
    speed: float = 0.5  # of the formation's centre, m/s
    radius: float | None = None  # of its path, m; None: what fits beside the formation
    size: float | None = None  # m, centre to outermost UAV; None: half of what fits, at most N
    period: float = 20.0  # s from one change to the next
    blend: float = 8.0  # s a change takes
    height: float | None = None  # m; None: mid-room
    margin: float = 0.5  # m kept from the walls

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "speed", "radius", "size", "period", "blend")
        if not self.shapes:
            raise ValueError("FormationChange: shapes is empty")
        for shape in self.shapes:
            if shape not in _SHAPES:
                raise ValueError(f"FormationChange: no shape {shape!r}, only {', '.join(_SHAPES)}")
        if not self.blend <= self.period:
            raise ValueError(
                f"FormationChange: blend = {self.blend:g} s must be at most the period of "
                f"{self.period:g} s"
            )
        size, radius = self._extent(arena)
        widest = min(half_extents(self, arena, self.margin)[:2])
        at_most(self, "size", size, 0.9 * widest, arena)
        at_most(self, "radius", radius, widest - size, arena)
        altitude(self, arena, self.height)
        return {}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        time = seconds(steps, arena.dt)
        size, radius = self._extent(arena)
        rate = self.speed / radius
        # The circle's angle; the formation's forward is the tangent (-sine, cosine).
        cosine, sine = (rate * time).cos(), (rate * time).sin()
        forward, left, forward_rate, left_rate = self._offsets(time, size, arena).unbind(-1)
        # Along the tangent and the inward normal, and their rates in the turning frame.
        tangential, inward = forward_rate + (self.speed - rate * left), left_rate + rate * forward
        outward = radius - left
        position = (
            arena.centre[0] + (outward * cosine - forward * sine),
            arena.centre[1] + (outward * sine + forward * cosine),
            altitude(self, arena, self.height),
        )
        velocity = (
            -tangential * sine - inward * cosine,
            tangential * cosine - inward * sine,
            0.0,
        )
        ahead = (-sine).expand_as(forward), cosine.expand_as(forward)
        return level_flight(position, velocity, ahead, arena.dim), carry

    def _offsets(
        self, time: Float64[Tensor, "R K 1"], size: float, arena: Arena
    ) -> Float64[Tensor, "R K N 4"]:
        """Each UAV's place in the formation, forward and left (m), and their rates (m/s)."""
        table = constant(_table(self.shapes, arena.n_uavs), time.device)
        number, fraction = cycles(time.squeeze(-1) / self.period)
        this = number.long().remainder(len(self.shapes))
        after = (number.long() + 1).remainder(len(self.shapes))
        since = fraction * self.period - (self.period - self.blend)
        share, rate = minimum_jerk((since / self.blend)[..., None, None])
        change = size * (table[after] - table[this])
        return torch.cat((size * table[this] + share * change, rate / self.blend * change), -1)

    def _extent(self, arena: Arena) -> tuple[float, float]:
        """Size of the formation and radius of its path (m)."""
        widest = min(half_extents(self, arena, self.margin)[:2])
        beside = widest - (self.radius or 0.0)
        size = min(0.5 * beside, arena.n_uavs) if self.size is None else self.size
        return size, widest - size if self.radius is None else self.radius


def _line(n: int) -> Shape:
    """Abreast."""
    return tuple((0.0, float(i)) for i in range(n))


def _ring(n: int) -> Shape:
    return tuple((math.cos(2 * math.pi * i / n), math.sin(2 * math.pi * i / n)) for i in range(n))


def _vee(n: int) -> Shape:
    """The leader in front, the others behind it to both sides."""
    return tuple((-float((i + 1) // 2), (i + 1) // 2 * (-1.0) ** i) for i in range(n))


def _grid(n: int) -> Shape:
    columns = math.ceil(math.sqrt(n))
    return tuple((-float(i // columns), float(i % columns)) for i in range(n))


_SHAPES = {"line": _line, "ring": _ring, "vee": _vee, "grid": _grid}


@lru_cache(maxsize=64)
def _table(shapes: tuple[str, ...], n: int) -> tuple[Shape, ...]:
    """Each shape's places (forward, left), centred, outermost at distance 1, from right to left."""
    return tuple(_normalised(_SHAPES[shape](n)) for shape in shapes)


def _normalised(places: Shape) -> Shape:
    middle = tuple(sum(axis) / len(places) for axis in zip(*places, strict=True))
    centred = [(x - middle[0], y - middle[1]) for x, y in places]
    largest = max(math.hypot(*place) for place in centred) or 1.0
    scaled = [(x / largest, y / largest) for x, y in centred]
    return tuple(sorted(scaled, key=lambda place: (round(place[1], 9), place[0])))
