"""``map``: recursive maximum a posteriori with the team's joint covariance, the reference that
keeps all correlations."""

from dataclasses import replace

import torch

from agents.swarm import delays as clocks
from agents.swarm import joint
from agents.swarm.anchored import supports_anchors
from agents.swarm.belief import Solution, StepInput, SwarmBelief
from agents.swarm.confidence import ConfidenceKind
from agents.swarm.gauss_newton import fixed_coordinates
from agents.swarm.joint_gauss_newton import JointGaussNewton
from coloc_env.options import PositiveCount
from coloc_env.scenario import Believed

_FIRST_STEP_REPEATS = 3  # further solutions of a first step


@supports_anchors
class RecursiveMap(JointGaussNewton):
    """Recursive maximum a posteriori with the team's full covariance. ``confidence``: ``em``,
    ``huber``, ``paper`` or ``none``, and ``bias``, as ``dwmds_st`` has them. ``delays=false`` does
    not estimate what clocks and antennas add to ranges.

    In a team's first step ranges are weighted again by the posterior covariance: a prior much wider
    than the noise cannot tell good ranges from bad. Few links could agree on a wrong place: where
    they are not dense, the first weights stay."""

    name = "map"

    def __init__(
        self,
        believed: Believed,
        *,
        confidence: ConfidenceKind = "em",
        iterations: PositiveCount = 3,
        bias: bool = True,
        delays: bool = True,
    ) -> None:
        super().__init__(believed, confidence, iterations, bias, delays)

    def solve(self, belief: SwarmBelief, inputs: StepInput) -> Solution:
        covariance = clocks.joint_covariance(inputs.joint, inputs.delays)
        fixed = fixed_coordinates(inputs.fixed, self.process.dim, covariance.shape[-1])
        precision = joint.information_of(covariance, fixed)  # Λ = P⁻¹
        solution = self.posterior(inputs, precision, inputs.prior)
        first_step = (belief.step == 0).any(-1)[:, None, None]
        for _ in range(_FIRST_STEP_REPEATS if self.dense and bool(first_step.any()) else 0):
            variance = torch.where(
                first_step, solution.range_variance(inputs), inputs.pair_variance
            )
            inputs = replace(inputs, pair_variance=variance)
            start = torch.where(first_step, solution.position, inputs.prior)
            solution = self.posterior(inputs, precision, start)
        return solution
