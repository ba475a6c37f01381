"""Gauss–Newton over the joint position of all UAVs, with all correlations: the base of ``gn``
(one snapshot, no prior) and ``map`` (recursive, prior from dead reckoning)."""

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.swarm import delays as clocks
from agents.swarm import joint
from agents.swarm.belief import Solution, StepInput
from agents.swarm.confidence import SolvedKind
from agents.swarm.filter import SwarmFilter, scaled
from agents.swarm.gauss_newton import fixed_coordinates, gauss_newton, information_matrix
from agents.swarm.links import lengths
from agents.swarm.multi_start import best_of, starts_about
from agents.swarm.weights import TRUNCATED
from coloc_env.scenario import Believed


class JointGaussNewton(SwarmFilter):
    """Gauss–Newton with ``iterations`` a step."""

    def __init__(
        self,
        believed: Believed,
        confidence: SolvedKind,
        iterations: int,
        starts: int = 1,
        bias: bool = False,
        delays: bool = False,
    ) -> None:
        super().__init__(believed, confidence, bias, delays)
        self.iterations, self.starts = iterations, starts

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
        position, delay = best_of(
            lambda at: self._solved(inputs, precision, at),
            lambda at, delay: self._cost(inputs, precision, at, delay),
            starts_about(start, inputs.variance.masked_fill(inputs.fixed, 0.0), self.starts),
        )
        weight, _ = self.weights_at(self._residual(inputs, position, delay), inputs)
        weight = self.confidence.information(weight, inputs)
        return self.with_covariance(inputs, precision, position, delay, weight)

    def _solved(
        self,
        inputs: StepInput,
        precision: Float64[Tensor, "B K K"],
        start: Float64[Tensor, "B N d"],
    ) -> tuple[Float64[Tensor, "B N d"], Float64[Tensor, "B N 2"]]:
        """Positions and delays (m) that the iterations reach from a start."""
        weights, iterations = self.confidence.schedule(inputs, self.iterations)
        return gauss_newton(
            start,
            inputs.links.distance,
            lambda residual: scaled(weights(residual), inputs.confidence),
            inputs.fixed,
            inputs.prior,
            precision,
            iterations,
        )[:2]

    def _residual(
        self,
        inputs: StepInput,
        position: Float64[Tensor, "B N d"],
        delay: Float64[Tensor, "B N 2"],
    ) -> Float64[Tensor, "B N N"]:
        residual = inputs.links.distance - lengths(position)
        return residual if self.clock is None else residual - clocks.offsets(delay)

    def _cost(
        self,
        inputs: StepInput,
        precision: Float64[Tensor, "B K K"],
        position: Float64[Tensor, "B N d"],
        delay: Float64[Tensor, "B N 2"],
    ) -> Float64[Tensor, "B"]:
        """½ Σ_{i<j} min(r²/σ², c̄²) + ½ (x − m)ᵀ Λ (x − m)."""
        squared = (self._residual(inputs, position, delay) / self.std).square()
        loss = (squared.clamp_max(TRUNCATED) * inputs.links.mask).sum((-2, -1))  # each link twice
        off = (position - inputs.prior).flatten(1)
        if precision.shape[-1] > off.shape[-1]:
            off = torch.cat((off, delay.flatten(1)), -1)
        return 0.25 * loss + 0.5 * (off * (precision @ off.unsqueeze(-1))[..., 0]).sum(-1)

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
