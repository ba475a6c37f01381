"""Agile flight: random splines whose speed, acceleration and jerk are bounded by construction."""

import math
from dataclasses import dataclass

from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.motion.draws import constant, fold_each, following, uav_keys, uniform
from coloc_env.motion.fit import half_extents, positive
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
    """A slow drift through the room and fast manoeuvres about it, body z axis along the thrust.

    The drift is a sine per axis, its rates and phases drawn per world and UAV. The manoeuvres are a
    uniform quintic B-spline (four continuous derivatives) with control points drawn in a box about
    the drift; both together never leave the room less its margin. The drift may use a third of each
    limit, the manoeuvres two thirds. Limits strictly bound the vectors' lengths; hours of flight in
    the room of ``indoor-v0`` with the defaults reach 3.4 m/s (mean 1.1), 6.2 m/s² and 23 m/s³. The
    yaw wanders with the drift, independent of the velocity, so it is defined at zero speed.
    """

    max_speed: float = 4.5  # m/s
    max_acceleration: float = 12.0  # m/s²
    max_jerk: float = 60.0  # m/s³
    margin: float = 0.5  # m kept from the walls

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "max_speed", "max_acceleration", "max_jerk")
        (wide, slow), (narrow, fast) = self._boxes(arena)
        dive = wide[-1] / slow**2 + PEAKS[1] * narrow[-1] / fast**2
        if arena.dim == 3 and not dive < 0.9 * GRAVITY:
            raise ValueError(
                f"Aggressive: max_acceleration = {self.max_acceleration:g} means {dive:.3g} m/s² "
                f"downwards; the thrust points up: at most {0.9 * GRAVITY:.3g}"
            )
        own = uav_keys(keys, arena.n_uavs)
        u = uniform(own, "motion.drift", 2 * (arena.dim + 1) + 1)
        rate, phase = u[..., : arena.dim + 1], u[..., arena.dim + 1 : -1]
        return {
            "keys": own,
            "rate": (0.5 + 0.5 * rate) / slow,
            "phase": 2 * math.pi * phase,
            "yaw": 2 * math.pi * u[..., -1],
        }

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        time = seconds(steps, arena.dt)
        (wide, _), (narrow, fast) = self._boxes(arena)
        drift = _sines(carry["rate"], carry["phase"], time, (*wide, math.pi))
        agile = _spline(carry["keys"], time, fast, narrow)
        position, velocity, acceleration = (
            slow[..., :-1] + quick for slow, quick in zip(drift, agile, strict=True)
        )
        yaw = drift[0][..., -1] + carry["yaw"].unsqueeze(1)
        cosine, sine = yaw.cos(), yaw.sin()
        if arena.dim == 3:
            attitude = thrust_attitude(acceleration, cosine, sine)
        else:
            attitude = yaw_attitude(cosine, sine, 2)
        position = constant(arena.centre, steps.device) + position
        return Kinematics(position, velocity, attitude), carry

    def _boxes(self, arena: Arena) -> tuple[tuple[tuple[float, ...], float], ...]:
        """Half extents (m) and time scale (s) of the drift (1 / fastest rate) and the manoeuvres.

        The manoeuvres' box is the one in which their limits of speed and of acceleration meet, half
        as high as wide, and at most half the room. Their time scale is the knots' spacing.
        """
        halves = half_extents(self, arena, self.margin)
        speed, acceleration = 2 / 3 * self.max_speed / PEAKS[0], 2 / 3 * self.max_acceleration
        shape = (1.0, 1.0, 0.5)[: arena.dim]
        size = speed * speed * PEAKS[1] / acceleration / math.hypot(*shape)
        fast = tuple(min(size * part, 0.5 * half) for part, half in zip(shape, halves, strict=True))
        slow = tuple(half - part for half, part in zip(halves, fast, strict=True))
        slow_scale = self._scale(slow, (1.0, 1.0, 1.0), 1 / 3)
        return (slow, slow_scale), (fast, self._scale(fast, PEAKS, 2 / 3))

    def _scale(self, box: tuple[float, ...], peaks: tuple[float, ...], share: float) -> float:
        """Shortest time scale (s) that keeps a share of all limits."""
        limits = (self.max_speed, self.max_acceleration, self.max_jerk)
        return max(
            (peak * math.hypot(*box) / (share * limit)) ** (1 / order)
            for order, (peak, limit) in enumerate(zip(peaks, limits, strict=True), start=1)
        )


def _sines(
    rate: Float64[Tensor, "R N c"],
    phase: Float64[Tensor, "R N c"],
    time: Float64[Tensor, "R K 1"],
    amplitude: tuple[float, ...],
) -> tuple[Float64[Tensor, "R K N c"], ...]:
    """Sines and their first two derivatives by time."""
    rate = rate.unsqueeze(1)
    angle = rate * time.unsqueeze(-1) + phase.unsqueeze(1)
    size = constant(amplitude, time.device)
    position = size * angle.sin()
    return position, (size * rate) * angle.cos(), -(rate * rate) * position


def _spline(
    keys: Int64[Tensor, "R N"],
    time: Float64[Tensor, "R K 1"],
    spacing: float,
    box: tuple[float, ...],
) -> tuple[Float64[Tensor, "R K N c"], ...]:
    """A random spline within ±box and its first two derivatives by time."""
    knot, u = cycles(time / spacing)
    widths = constant(tuple(2 * half for half in box), time.device)
    drawn = uniform(fold_each(keys, following(knot.long(), 6)), "motion.aggressive", len(box))
    control = (drawn - 0.5) * widths
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
    weights: Float64[Tensor, "R K 1 6"], control: Float64[Tensor, "6 R K N c"]
) -> Float64[Tensor, "R K N c"]:
    """Sum of the control points by their weights, in a fixed order."""
    total = weights[..., :1] * control[0]
    for i in range(1, 6):
        total = total + weights[..., i : i + 1] * control[i]
    return total
