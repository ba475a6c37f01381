"""References for swarms that keep all correlations of a team: the snapshot's and the recursive one.

Gauss–Newton over the joint position of all UAVs, without a prior (``gn``) and with the joint
covariance that dead reckoning has carried on (``map``).
"""

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.swarm import delays, joint
from agents.swarm.belief import Found, Prepared
from agents.swarm.filter import Confidence, SwarmFilter
from agents.swarm.gauss_newton import coordinates, gauss_newton, informed
from agents.swarm.links import lengths
from coloc_env.scenario import Believed

_AGAIN = 3  # times that a first step is solved once more


class JointSolution(SwarmFilter):
    """Gauss–Newton with ``iterations`` a step."""

    def __init__(
        self,
        believed: Believed,
        confidence: Confidence,
        iterations: int,
        bias: bool = False,
        delays: bool = False,
    ) -> None:
        super().__init__(believed, confidence, bias, delays)
        if iterations < 1:
            raise ValueError(f"iterations={iterations} is not allowed: at least 1")
        self.iterations = iterations

    def joint(self, variance: Float64[Tensor, "B N"]) -> Float64[Tensor, "B N d K"]:
        return joint.independent(variance, self.process.dim)

    def solved(
        self, now: Prepared, precision: Float64[Tensor, "B K K"], start: Float64[Tensor, "B N d"]
    ) -> Found:
        """Positions, and the inverse of their joint information."""
        position, late, _ = gauss_newton(
            start,
            now.links.distance,
            lambda residual: self.weigh_residual(residual, now),
            now.fixed,
            now.place,
            precision,
            self.iterations,
        )
        residual = now.links.distance - lengths(position) - delays.added(late)
        weight, _ = self.weigh_residual(residual, now)
        d, size = self.process.dim, precision.shape[-1]
        told = informed(position, self.told(weight, now), self.clock is not None)
        known = now.variance.repeat_interleave(d, -1)
        known = torch.nn.functional.pad(known, (0, size - known.shape[-1]))
        still = coordinates(now.fixed, d, size)
        covariance = joint.left_by(told + precision, still, known)
        together, learned = delays.parts(covariance, now.delays.delay + late, d)
        return Found(position, joint.variances(together), together, delays=learned)
