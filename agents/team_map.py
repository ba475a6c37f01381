"""References for swarms that keep all correlations of a team: the snapshot's and the recursive one.

Gauss–Newton over the joint position of all UAVs, without a prior (``gn``) and with the joint
covariance that dead reckoning has carried on (``map``).
"""

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.localizer import register
from agents.swarm import joint
from agents.swarm.belief import Found, Prepared, SwarmBelief
from agents.swarm.filter import Confidence, SwarmFilter
from agents.swarm.gauss_newton import fisher, gauss_newton
from coloc_env.scenario import Believed


class _Joint(SwarmFilter):
    """Gauss–Newton with ``iterations`` a step."""

    def __init__(
        self, believed: Believed, confidence: Confidence, iterations: int, bias: bool = False
    ) -> None:
        super().__init__(believed, confidence, bias)
        if iterations < 1:
            raise ValueError(f"iterations={iterations} is not allowed: at least 1")
        self.iterations = iterations

    def joint(self, variance: Float64[Tensor, "B N"]) -> Float64[Tensor, "B N d K"]:
        return joint.independent(variance, self.process.dim)

    def solved(self, now: Prepared, precision: Float64[Tensor, "B K K"]) -> Found:
        """Positions, and the inverse of their joint information."""
        position, _ = gauss_newton(
            now.place,
            now.links.distance,
            lambda residual: self.weigh_residual(residual, now),
            now.fixed,
            now.place,
            precision,
            self.iterations,
        )
        weight, _ = self.weigh(position, now)
        told = fisher(position, self.told(weight, now)).flatten(3).flatten(1, 2)
        together = joint.posterior(told + precision, now.fixed, now.variance)
        return Found(position, joint.variances(together), together)


@register("gn")
class Snapshot(_Joint):
    """Gauss–Newton on the ranges of one step, started where dead reckoning is. ``confidence``:
    ``huber``, ``em`` or ``none``, as ``dwmds_st`` has it."""

    name = "gn"
    recursive = False

    def __init__(
        self, believed: Believed, *, confidence: Confidence = "huber", iterations: int = 6
    ) -> None:
        super().__init__(believed, confidence, iterations)

    def find(self, belief: SwarmBelief, now: Prepared) -> Found:
        return self.solved(now, torch.zeros_like(belief.joint.flatten(1, 2)))


@register("map")
class RecursiveMap(_Joint):
    """Recursive maximum a posteriori with the team's full covariance. ``confidence``: ``em``,
    ``huber`` or ``none``, and ``bias``, as ``dwmds_st`` has them."""

    name = "map"

    def __init__(
        self,
        believed: Believed,
        *,
        confidence: Confidence = "em",
        iterations: int = 3,
        bias: bool = True,
    ) -> None:
        super().__init__(believed, confidence, iterations, bias)

    def find(self, belief: SwarmBelief, now: Prepared) -> Found:
        return self.solved(now, joint.precision(now.joint, now.fixed))
