"""``map``: recursive maximum a posteriori with the team's joint covariance, the reference that
keeps all correlations."""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, Literal, TypeVar

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.swarm import delays as clocks
from agents.swarm import joint, joint_bias
from agents.swarm.anchored import supports_anchors
from agents.swarm.belief import Solution, StepInput, SwarmBelief
from agents.swarm.confidence import SolvedKind
from agents.swarm.expectation_propagation import (
    Cavity,
    Sites,
    cavity,
    length_variance,
    sites_by_moments,
)
from agents.swarm.gauss_newton import fixed_coordinates, gauss_newton
from agents.swarm.joint_gauss_newton import JointGaussNewton
from coloc_env.options import PositiveCount
from coloc_env.scenario import Believed

_FIRST_STEP_REPEATS = 3  # further solutions of a first step
_PASSES, _FIRST_PASSES = 3, 5  # of expectation propagation, in a step and in the first
_T = TypeVar("_T", Sites, Solution)
Adjust = Callable[[int, StepInput, Cavity, Sites], Sites]


@supports_anchors
class RecursiveMap(JointGaussNewton):
    """Recursive maximum a posteriori with the team's full covariance.

    ``confidence``: ``em``, ``huber``, ``paper`` or ``none``, as ``dwmds_st`` has them; ``gnc``:
    truncated least squares by graduated non-convexity (25 iterations at least). With ``em``,
    ``factors=ep`` approximates the factor of each range by expectation propagation, one
    Gauss–Newton iteration a pass; ``weights`` by the responsibilities at its residual, with
    ``iterations`` a step, from so many ``starts`` (the prior, and draws from it), of which the best
    counts. ``bias``: of the INS's biases the covariance with each other and with all
    positions is kept (``joint``), or each UAV's own alone (``own``); ``none``: they are not
    estimated. ``delays=false`` does not estimate what clocks and antennas add to ranges.

    With ``weights``, in a team's first step ranges are weighted again by the posterior covariance:
    a prior much wider than the noise cannot tell good ranges from bad. Few links could agree on a
    wrong place: where they are not dense, the first weights stay."""

    name = "map"

    def __init__(
        self,
        believed: Believed,
        *,
        confidence: SolvedKind = "em",
        factors: Literal["ep", "weights"] = "ep",
        iterations: PositiveCount = 3,
        starts: PositiveCount = 1,
        bias: Literal["joint", "own", "none"] = "joint",
        delays: bool = True,
    ) -> None:
        super().__init__(believed, confidence, iterations, starts, bias != "none", delays)
        self.jointly_biased = bias == "joint" and self.ins is not None
        self.propagates = factors == "ep" and confidence == "em"
        if self.propagates and starts > 1:
            raise ValueError(
                f"starts={starts} is not allowed with confidence=em and factors=ep: one start"
            )

    def solve(
        self, belief: SwarmBelief, inputs: StepInput, adjust: Adjust | None = None
    ) -> Solution:
        """``adjust``: another word on the sites of each pass of expectation propagation."""
        covariance = clocks.joint_covariance(inputs.joint, inputs.delays)
        fixed = fixed_coordinates(inputs.fixed, self.process.dim, covariance.shape[-1])
        precision = joint.information_of(covariance, fixed)  # Λ = P⁻¹
        first = (belief.step == 0).any(-1)
        if self.propagates:
            solution = self._propagated(inputs, precision, first, adjust)
        else:
            solution = self._weighted(inputs, precision, first[:, None, None])
        return self._with_biases(inputs, precision, solution)

    def _propagated(
        self,
        inputs: StepInput,
        precision: Float64[Tensor, "B K K"],
        first: Bool[Tensor, "B"],
        adjust: Adjust | None,
    ) -> Solution:
        """By expectation propagation: sites from the posterior, the posterior from the sites."""
        delays = None if self.clock is None else inputs.delays
        solution = Solution(inputs.prior, inputs.variance, inputs.joint, delays=delays)
        nothing = torch.zeros_like(inputs.pair_variance)
        found = sites = Sites(nothing, nothing, nothing)
        for k in range(_FIRST_PASSES if bool(first.any()) else _PASSES):
            before = sites, solution
            assert solution.joint is not None
            known = inputs.delays if solution.delays is None else solution.delays
            variance = length_variance(solution.joint, known, solution.position)
            at = cavity(solution.residual(inputs), variance, sites)
            found = sites_by_moments(at, inputs, self.std, found if k else None)
            sites = found if adjust is None else adjust(k, inputs, at, found)
            solution = self._by_sites(inputs, precision, solution.position, sites)
            if k >= _PASSES:  # other worlds have had all of theirs
                sites = _of_worlds(first, sites, before[0])
                solution = _of_worlds(first, solution, before[1])
        return replace(solution, outlier=sites.outlier)

    def _by_sites(
        self,
        inputs: StepInput,
        precision: Float64[Tensor, "B K K"],
        start: Float64[Tensor, "B N d"],
        sites: Sites,
    ) -> Solution:
        """The posterior with these factors of ranges, linearized at ``start``."""
        position, delay, _ = gauss_newton(
            start,
            inputs.links.distance,
            lambda residual: (sites.weight, sites.shift),
            inputs.fixed,
            inputs.prior,
            precision,
            1,
        )
        return self.with_covariance(inputs, precision, position, delay, sites.weight)

    def _weighted(
        self,
        inputs: StepInput,
        precision: Float64[Tensor, "B K K"],
        first_step: Float64[Tensor, "B 1 1"],
    ) -> Solution:
        """By the confidence's weights."""
        solution = self.posterior(inputs, precision, inputs.prior)
        for _ in range(_FIRST_STEP_REPEATS if self.dense and bool(first_step.any()) else 0):
            variance = torch.where(
                first_step, solution.range_variance(inputs), inputs.pair_variance
            )
            inputs = replace(inputs, pair_variance=variance)
            start = torch.where(first_step, solution.position, inputs.prior)
            solution = self.posterior(inputs, precision, start)
        return solution

    def _with_biases(
        self, inputs: StepInput, precision: Float64[Tensor, "B K K"], solution: Solution
    ) -> Solution:
        """The solution with what it says of the INS's biases."""
        if inputs.ins_bias is None or inputs.joint_bias is None:
            return solution
        moved, delays = (solution.position - inputs.prior).flatten(1), inputs.delays
        if solution.delays is not None:
            delays = solution.delays
            by = (delays.delay - inputs.delays.delay).flatten(1)
            moved = torch.cat((moved, by), -1)
        assert solution.joint is not None
        posterior = clocks.joint_covariance(solution.joint, delays)
        found = joint_bias.update(inputs.ins_bias, inputs.joint_bias, moved, precision, posterior)
        return replace(solution, joint_bias=found)


def _of_worlds(chosen: Bool[Tensor, "B"], these: _T, others: _T) -> _T:
    """The ``chosen`` worlds of the one, and the rest of the other."""
    parts: dict[str, Any] = {}
    for field in fields(these):
        one, other = getattr(these, field.name), getattr(others, field.name)
        if isinstance(one, Tensor):
            parts[field.name] = torch.where(chosen.reshape(-1, *[1] * (one.ndim - 1)), one, other)
        elif one is not None:  # a tensorclass of batch (B, N)
            rows = chosen.unsqueeze(-1).expand(one.batch_size)
            parts[field.name] = one.where(rows, other)
    return replace(these, **parts)
