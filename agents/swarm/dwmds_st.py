"""DW-MDS: dynamically weighted multidimensional scaling of a swarm (ST-DCL paper, Algorithm 1).

The team's stress (equation 19) is minimized by majorization, warm-started at the positions of dead
reckoning. The paper's window of past ranges is folded into a recursive prior with a joint
covariance, or kept as it is (``window``).
"""

from dataclasses import replace
from typing import Annotated

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from agents.kalman.filter import elapsed
from agents.swarm import adaptive, joint
from agents.swarm import window as windows
from agents.swarm.anchored import supports_anchors
from agents.swarm.belief import Solution, StepInput, SwarmBelief
from agents.swarm.confidence import ConfidenceKind
from agents.swarm.filter import SwarmFilter
from agents.swarm.majorization import TEAM_RELAXATION, require_iterations
from coloc_env.options import Count, PositiveCount, PositiveSpeed, Quantity
from coloc_env.scenario import Believed

_REWEIGHTED = (0, 2)  # iterations at which weights are computed
_REWEIGHTED_EVERY = 10  # in the first step, as well
_NO_PRIOR = 1e-9  # m⁻²: precision of a prior that is not used


@supports_anchors
class DynamicMds(SwarmFilter):
    """Whole-team stress majorization with a recursive prior from dead reckoning.

    The joint covariance is shared by all axes, which suffices where UAVs have twenty neighbours and
    more in all directions; ``map`` keeps all of it, at three times the cost.

    ``confidence``: weights of links: ``em`` by a mixture of errors that is fitted to the links
    between anchors, ``huber``, ``paper`` (Huber's times equation 17), or ``none`` (all alike).
    ``bias=false`` does not estimate the INS's. ``prior=false`` uses dead reckoning as the initial
    guess only. ``v_max`` (m/s): bound of velocities (the paper's projection). ``iterations`` a
    step, ``first`` in the first.

    ``window``: past steps in the stress, displaced by dead reckoning, with weights exp(−λ age), λ
    the ``decay`` in 1/s; the prior is then that of the oldest of them. The paper's T is
    min(T_max, ⌈√(2R/a_max)/Δt⌉), R the radius of communication. Displacements are taken for exact,
    ``decay`` stands for their errors.

    ``adaptive=true``: as printed, λ follows the error that dead reckoning accumulates and λ_s the
    average degree (``agents.swarm.adaptive``): a prior whose weight is the links' own, not that of
    its covariance, which the estimate's covariance then inherits.
    """

    name = "dwmds_st"

    def __init__(
        self,
        believed: Believed,
        *,
        confidence: ConfidenceKind = "em",
        bias: bool = True,
        prior: bool = True,
        v_max: PositiveSpeed | None = None,
        window: Count = 0,
        decay: Annotated[float, Quantity("1/s", 0.0)] = 0.05,
        adaptive: bool = False,
        iterations: PositiveCount = 5,
        first: PositiveCount = 60,
    ) -> None:
        super().__init__(believed, confidence, bias)
        require_iterations(iterations, first)
        self.prior, self.iterations, self.first, self.v_max = prior, iterations, first, v_max
        self.window, self.decay, self.adaptive = window, decay, adaptive
        self.recursive = prior

    def initial_joint(self, variance: Float64[Tensor, "B N"]) -> Float64[Tensor, "B N e K"]:
        return joint.independent(variance, 1)

    def solve(self, belief: SwarmBelief, inputs: StepInput) -> Solution:
        """Algorithm 1's inner loop, y ← y + ω V⁻¹ (−½ ∂S/∂y), and the covariance of its result."""
        first_step = (belief.step == 0).any(-1)[:, None, None]
        free = joint.free_indices(inputs.fixed)
        fixed, window = inputs.fixed.unsqueeze(-1), inputs.window
        prior, covariance = inputs.prior, inputs.joint
        if window is not None and not self.adaptive:
            prior, covariance = windows.oldest_prior(window)
        precision = self._precision(covariance, inputs, free)  # Λ
        majorant, information = precision, precision  # of all terms but the step's own links
        if window is not None:
            past = window.information.sum(2) / self.process.dim
            majorant = precision + joint.laplacian(window.weight.sum(2), free)
            information = precision + joint.laplacian(past, free)
        pairs, weighting = inputs.links.pairs, inputs.listed
        distance, y, factor = weighting.links.distance, inputs.prior, precision
        weight, shift = torch.zeros_like(distance), torch.zeros_like(distance)
        relaxation = TEAM_RELAXATION if self.dense else 1.0  # ω
        for k in range(self.first if bool(first_step.any()) else self.iterations):
            active = first_step | (k < self.iterations)  # other worlds have fewer iterations
            unit, length = pairs.units(y)
            if k in _REWEIGHTED or k % _REWEIGHTED_EVERY == 0:
                if k == _REWEIGHTED[-1] and bool(first_step.any()):
                    each = self.confidence.information(weight, weighting)
                    posterior = self._posterior(each, information, inputs, free)
                    weighting = self._first_reweighting(posterior, inputs, first_step)
                found = self.weights_at(distance - length, weighting)
                weight, shift = (
                    torch.where(active[..., 0], new, old)
                    for new, old in zip(found, (weight, shift), strict=True)
                )
                v = pairs.laplacian(weight, free) + majorant
                v = joint.pin(v, inputs.fixed[:, free])
                factor = torch.linalg.cholesky_ex(v).L  # V, the Laplacian of W plus Λ
            strength = weight * (distance - shift - length)
            descent = pairs.along(strength.unsqueeze(1), unit)
            if window is not None:
                descent = descent + windows.descent(y, window)
            descent = torch.where(fixed, 0.0, descent)[:, free]
            descent = descent + precision @ (prior - y)[:, free]
            step = relaxation * torch.cholesky_solve(descent, factor)
            y = torch.where(active, y.index_add(1, free, step), y)
        if self.v_max is not None:
            y = self._projected(belief, inputs, y)
        weight, shift = self.weights(y, weighting)
        each = self.confidence.information(weight, weighting)
        posterior = self._posterior(each, information, inputs, free)
        if window is not None:
            links = (pairs.matrix(x.unsqueeze(1)) for x in (distance - shift, weight, each))
            window = windows.push(window, inputs.prior, inputs.joint, *links)
        return Solution(y, joint.marginal_variances(posterior), posterior, window)

    def decay_rate(
        self,
        noise: Float64[Tensor, "B N"],
        fixed: Bool[Tensor, "B N"],
        dt: Float64[Tensor, "B N"],
    ) -> float | Float64[Tensor, "B 1"]:
        return adaptive.decay(noise, ~fixed, self.std, dt) if self.adaptive else self.decay

    def _precision(
        self,
        covariance: Float64[Tensor, "B N e K"],
        inputs: StepInput,
        free: Int64[Tensor, "M"],
    ) -> Float64[Tensor, "B L L"]:
        """The precision Λ of the prior (1/m²), at free UAVs: P⁻¹, or λ_s/(σ Δt)² I."""
        fixed = inputs.fixed[:, free]
        if self.prior and not self.adaptive:
            return joint.precision(joint.submatrix(covariance, free), fixed)
        each = (~fixed).double()
        if not self.prior:
            return torch.diag_embed(_NO_PRIOR * each)
        strength = adaptive.smoothing(inputs.links.mask, self.std).clamp_min(_NO_PRIOR)
        return torch.diag_embed(strength.unsqueeze(-1) * each)

    def _posterior(
        self,
        each: Float64[Tensor, "B E"],
        information: Float64[Tensor, "B L L"],
        inputs: StepInput,
        free: Int64[Tensor, "M"],
    ) -> Float64[Tensor, "B N e K"]:
        """The joint covariance by what ``each`` of the step's links informs, and all other
        ``information`` (1/m²)."""
        total = inputs.links.pairs.laplacian(each / self.process.dim, free) + information
        part = joint.posterior(total, inputs.fixed[:, free], inputs.variance[:, free])
        return joint.embed(part, free, inputs.variance)

    def _first_reweighting(
        self,
        posterior: Float64[Tensor, "B N e K"],
        inputs: StepInput,
        first_step: Bool[Tensor, "B 1 1"],
    ) -> StepInput:
        """The listed inputs of worlds at their first step with the variance of the posterior: a
        prior much wider than the noise cannot tell good ranges from bad."""
        variance = torch.where(first_step, joint.pair_variance(posterior), inputs.pair_variance)
        return replace(inputs, pair_variance=variance).listed

    def _projected(
        self, belief: SwarmBelief, inputs: StepInput, y: Float64[Tensor, "B N d"]
    ) -> Float64[Tensor, "B N d"]:
        """Algorithm 1's projection (lines 5–11): no velocity is larger than ``v_max``."""
        assert self.v_max is not None
        before = belief.state[..., : self.process.dim]
        reach = self.v_max * elapsed(self.process, belief.step).double().unsqueeze(-1)
        displacement = y - before
        length = displacement.norm(dim=-1, keepdim=True)
        factor = (reach / length.clamp_min(1e-9)).clamp_max(1.0)
        kept = inputs.fixed.unsqueeze(-1) | (reach <= 0)
        return torch.where(kept, y, before + factor * displacement)
