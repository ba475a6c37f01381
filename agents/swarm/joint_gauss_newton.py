"""Gauss–Newton over the joint position of all UAVs, with all correlations: the base of ``gn``
(one snapshot, no prior) and ``map`` (recursive, prior from dead reckoning)."""

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.swarm import delays as clocks
from agents.swarm import joint
from agents.swarm.belief import Solution, StepInput
from agents.swarm.confidence import ConfidenceKind
from agents.swarm.filter import SwarmFilter
from agents.swarm.gauss_newton import fixed_coordinates, gauss_newton, information_matrix
from agents.swarm.links import lengths
from coloc_env.scenario import Believed


class JointGaussNewton(SwarmFilter):
    """Gauss–Newton with ``iterations`` a step."""

    def __init__(
        self,
        believed: Believed,
        confidence: ConfidenceKind,
        iterations: int,
        bias: bool = False,
        delays: bool = False,
    ) -> None:
        super().__init__(believed, confidence, bias, delays)
        self.iterations = iterations

    def initial_joint(self, variance: Float64[Tensor, "B N"]) -> Float64[Tensor, "B N d K"]:
        return joint.independent(variance, self.process.dim)

    def posterior(
        self,
        inputs: StepInput,
        precision: Float64[Tensor, "B K K"],
        start: Float64[Tensor, "B N d"],
    ) -> Solution:
        """The maximum a posteriori for a prior of this joint ``precision`` Λ (1/m²), and the
        inverse of the joint information, Σ = (Jᵀ W J + Λ)⁻¹."""
        position, delay, _ = gauss_newton(
            start,
            inputs.links.distance,
            lambda residual: self.weights_at(residual, inputs),
            inputs.fixed,
            inputs.prior,
            precision,
            self.iterations,
        )
        residual = inputs.links.distance - lengths(position)
        if self.clock is not None:
            residual = residual - clocks.offsets(delay)
        weight, _ = self.weights_at(residual, inputs)
        weight = self.confidence.information(weight, inputs)
        return self.with_covariance(inputs, precision, position, delay, weight)

    def with_covariance(
        self,
        inputs: StepInput,
        precision: Float64[Tensor, "B K K"],
        position: Float64[Tensor, "B N d"],
        delay: Float64[Tensor, "B N 2"],
        weight: Float64[Tensor, "B N N"],
    ) -> Solution:
        """The solution at this ``position`` and with this correction of the delays (m), for ranges
        of this information (1/m²)."""
        information = information_matrix(position, weight, self.clock is not None)
        d, size = self.process.dim, precision.shape[-1]
        fixed = fixed_coordinates(inputs.fixed, d, size)
        variance = inputs.variance.repeat_interleave(d, -1)
        variance = torch.nn.functional.pad(variance, (0, size - variance.shape[-1]))
        whole = joint.covariance_of(information + precision, fixed, variance)
        covariance, delays = clocks.split(whole, inputs.delays.delay + delay, d)
        return Solution(
            position,
            joint.marginal_variances(covariance),
            covariance,
            delays=delays if self.clock is not None else None,
        )
