"""Smooth time laws: rest-to-rest and stop-and-go."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

MINIMUM_JERK_SPEED = 1.875  # peak of the minimum-jerk law's first derivative
_ON_TIME = 1e-9  # a step that ends a cycle up to rounding begins the next one


def seconds(steps: Tensor, dt: float) -> Float64[Tensor, "R K 1"]:
    """Time of each step (s), ready to broadcast over UAVs."""
    return (steps.to(torch.float64) * dt).unsqueeze(-1)


def cycles(
    turns: Float64[Tensor, "*s"],
) -> tuple[Float64[Tensor, "*s"], Float64[Tensor, "*s"]]:
    """Whole cycles completed, and the fraction of the current one."""
    whole = (turns + _ON_TIME).floor()
    return whole, turns - whole


def alternating(cycle: Float64[Tensor, "*s"]) -> Float64[Tensor, "*s"]:
    """1 in even cycles, −1 in odd ones."""
    return 1 - 2 * (cycle - 2 * (0.5 * cycle).floor())


def minimum_jerk(u: Float64[Tensor, "*s"]) -> tuple[Float64[Tensor, "*s"], Float64[Tensor, "*s"]]:
    """From 0 to 1, at rest outside 0 < u < 1: s = 10 u³ − 15 u⁴ + 6 u⁵, and ds/du."""
    u = u.clamp(0.0, 1.0)
    squared, left = u * u, 1 - u
    return squared * u * (10 - 15 * u + 6 * squared), 30 * squared * left * left


@dataclass(frozen=True)
class StopAndGoLaw:
    """Speed that repeats: up to 1 in ``ramp``, ``cruise``, down in ``ramp``, at rest for ``pause``.

    The ramps are minimum-jerk, so acceleration is continuous, with peak 1.875 / ramp.
    """

    cruise: float
    ramp: float
    pause: float

    @property
    def period(self) -> float:
        return self.cruise + 2 * self.ramp + self.pause

    @property
    def travel(self) -> float:
        """Distance of one cycle at unit speed (s)."""
        return self.cruise + self.ramp

    def at(
        self, turns: Float64[Tensor, "*s"]
    ) -> tuple[Float64[Tensor, "*s"], Float64[Tensor, "*s"], Float64[Tensor, "*s"], Tensor]:
        """Cycle number, distance within it (s), speed, and progress of the rest from 0 to 1.

        ``turns`` counts time in cycles.
        """
        cycle, fraction = cycles(turns)
        time = fraction * self.period
        brake = self.ramp + self.cruise
        rise, fall = (time / self.ramp).clamp(0.0, 1.0), (time - brake) / self.ramp
        fall = fall.clamp(0.0, 1.0)
        cruised = time.clamp(self.ramp, brake) - self.ramp
        ramped = self.ramp * (_ramp_distance(rise) + fall - _ramp_distance(fall))
        rest = minimum_jerk((time - brake - self.ramp) / self.pause)[0]
        return cycle, cruised + ramped, minimum_jerk(rise)[0] - minimum_jerk(fall)[0], rest


def _ramp_distance(u: Float64[Tensor, "*s"]) -> Float64[Tensor, "*s"]:
    """Integral of the minimum-jerk law."""
    squared = u * u
    return squared * squared * (2.5 - 3 * u + squared)
