"""``gn``: Gauss–Newton on the ranges of one step, the reference without a prior."""

import torch

from agents.swarm.anchored import supports_anchors
from agents.swarm.belief import Solution, StepInput, SwarmBelief
from agents.swarm.confidence import SolvedKind
from agents.swarm.joint_gauss_newton import JointGaussNewton
from coloc_env.options import PositiveCount
from coloc_env.scenario import Believed


@supports_anchors
class Snapshot(JointGaussNewton):
    """Gauss–Newton on the ranges of one step, started where dead reckoning is. ``confidence``:
    ``huber``, ``em``, ``paper`` or ``none``, as ``dwmds_st`` has it, or ``gnc``, truncated least
    squares by graduated non-convexity. ``iterations`` from each of so many ``starts`` (dead
    reckoning, and draws about it), of which the best counts."""

    name = "gn"
    recursive = False

    def __init__(
        self,
        believed: Believed,
        *,
        confidence: SolvedKind = "huber",
        iterations: PositiveCount = 6,
        starts: PositiveCount = 1,
    ) -> None:
        super().__init__(believed, confidence, iterations, starts)

    def solve(self, belief: SwarmBelief, inputs: StepInput) -> Solution:
        no_prior = torch.zeros_like(belief.joint.flatten(1, 2))
        return self.posterior(inputs, no_prior, inputs.prior)
