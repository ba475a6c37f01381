"""Agile flight: random splines whose speed, acceleration and jerk are bounded by construction."""

import math
from dataclasses import dataclass

from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.motion.draws import constant, fold_each, uav_keys, uniform
from coloc_env.motion.fit import at_most, half_extents, positive
from coloc_env.motion.frames import GRAVITY, thrust_attitude, yaw_attitude
from coloc_env.motion.timing import cycles, seconds

_BASIS = (  # quintic uniform B-spline: 120 × the coefficients of u⁰ … u⁵ of the six control points
    (1, -5, 10, -10, 5, -1),
    (26, -50, 20, 20, -20, 5),
    (66, 0, -60, 0, 30, -10),
    (26, 50, 20, -20, -20, 10),
    (1, 5, 10, 10, 5, -5),
    (0, 0, 0, 0, 0, 1),
)
# Largest sum over control points of |k-th derivative|: the derivative's peak per unit amplitude.
PEAKS = (115 / 96, 2.0, 4.5)


@dataclass(frozen=True)
class Aggressive(Motion):
    """A slow random spline through the room and a fast one about it, z axis along the thrust.

    Both are uniform quintic B-splines (four continuous derivatives) with control points drawn per
    world and UAV in boxes that add up to the room less its margin, which they therefore never leave.
    The slow one may use a third of each limit, the fast one two thirds. Limits bound the vectors'
    lengths strictly; REACHED. The yaw wanders slowly, independent of the velocity, so it is defined
    at zero speed.
    """

    max_speed: float = 4.5  # m/s
    max_acceleration: float = 12.0  # m/s²
    max_jerk: float = 60.0  # m/s³
    margin: float = 0.5  # m kept from the walls

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "max_speed", "max_acceleration", "max_jerk")
        splines = self._splines(arena)
        if arena.dim == 3:  # the thrust must point upwards
            dive = sum(PEAKS[1] * box[2] / spacing**2 for box, spacing in splines)
            limit = 0.9 * GRAVITY * self.max_acceleration / dive
            at_most(self, "max_acceleration", self.max_acceleration, limit, arena)
        own = uav_keys(keys, arena.n_uavs)
        return {"keys": own, "yaw": 2 * math.pi * uniform(own, "motion.yaw", 1).squeeze(-1)}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        time = seconds(steps, arena.dt)
        (wide, slow), (narrow, fast) = self._splines(arena)
        drift = _spline(carry["keys"], "drift", time, slow, (*wide, math.pi))
        agile = _spline(carry["keys"], "agile", time, fast, narrow)
        position, velocity, acceleration = (
            a[..., :-1] + b for a, b in zip(drift, agile, strict=True)
        )
        yaw = drift[0][..., -1] + carry["yaw"].unsqueeze(1)
        cosine, sine = yaw.cos(), yaw.sin()
        if arena.dim == 3:
            attitude = thrust_attitude(acceleration, cosine, sine)
        else:
            attitude = yaw_attitude(cosine, sine, 2)
        return Kinematics(constant(arena.centre, steps.device) + position, velocity, attitude), carry

    def _splines(self, arena: Arena) -> tuple[tuple[tuple[float, ...], float], ...]:
        """Half extents of the control points' box (m) and their spacing (s): slow spline, fast one.

        The fast box is the one in which the limits of speed and of acceleration meet, half as high
        as wide, and at most half the room.
        """
        halves = half_extents(self, arena, self.margin)
        speed, acceleration = 2 / 3 * self.max_speed / PEAKS[0], 2 / 3 * self.max_acceleration
        shape = (1.0, 1.0, 0.5)[: arena.dim]
        size = speed * speed * PEAKS[1] / acceleration / math.hypot(*shape)
        fast = tuple(min(size * part, 0.5 * half) for part, half in zip(shape, halves, strict=True))
        slow = tuple(half - part for half, part in zip(halves, fast, strict=True))
        return (slow, self._spacing(slow, 1 / 3)), (fast, self._spacing(fast, 2 / 3))

    def _spacing(self, box: tuple[float, ...], share: float) -> float:
        """Shortest time between control points (s) that keeps a share of all limits."""
        limits = (self.max_speed, self.max_acceleration, self.max_jerk)
        return max(
            (peak * math.hypot(*box) / (share * limit)) ** (1 / order)
            for order, (peak, limit) in enumerate(zip(PEAKS, limits, strict=True), start=1)
        )


def _spline(
    keys: Int64[Tensor, "R N"],
    name: str,
    time: Float64[Tensor, "R K 1"],
    spacing: float,
    box: tuple[float, ...],
) -> tuple[Float64[Tensor, "R K N c"], ...]:
    """A random spline within ±box and its first two derivatives by time."""
    knot, u = cycles(time / spacing)
    widths = constant(tuple(2 * half for half in box), time.device)
    control = [
        (uniform(fold_each(keys, knot.long() + i), f"motion.{name}", len(box)) - 0.5) * widths
        for i in range(6)
    ]
    return tuple(_weighted(_weights(u, order, spacing), control) for order in range(3))


def _weights(u: Float64[Tensor, "R K 1"], order: int, spacing: float) -> Float64[Tensor, "R K 1 6"]:
    """The order-th derivative by time of the basis at a fraction u of a segment (Horner)."""
    scale = 120 * spacing**order
    powers = constant(
        tuple(
            tuple(math.perm(power, order) * row[power] / scale for row in _BASIS)
            for power in range(5, order - 1, -1)
        ),
        u.device,
    )
    weights = powers[0].expand(*u.shape, 6)
    for coefficients in powers[1:]:
        weights = weights * u.unsqueeze(-1) + coefficients
    return weights


def _weighted(
    weights: Float64[Tensor, "R K 1 6"], control: list[Float64[Tensor, "R K N c"]]
) -> Float64[Tensor, "R K N c"]:
    """Sum of the control points by their weights, in a fixed order."""
    total = weights[..., :1] * control[0]
    for i in range(1, 6):
        total = total + weights[..., i : i + 1] * control[i]
    return total
