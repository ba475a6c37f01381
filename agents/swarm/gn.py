"""``gn``: Gauss–Newton on the ranges of one step, the reference without a prior."""

import torch

from agents.swarm.anchored import supports_anchors
from agents.swarm.belief import Solution, StepInput, SwarmBelief
from agents.swarm.confidence import ConfidenceKind
from agents.swarm.joint_gauss_newton import JointGaussNewton
from coloc_env.options import PositiveCount
from coloc_env.scenario import Believed


@supports_anchors
class Snapshot(JointGaussNewton):
    """Gauss–Newton on the ranges of one step, started where dead reckoning is. ``confidence``:
    ``huber``, ``em``, ``paper`` or ``none``, as ``dwmds_st`` has it."""

    name = "gn"
    recursive = False

    def __init__(
        self,
        believed: Believed,
        *,
        confidence: ConfidenceKind = "huber",
        iterations: PositiveCount = 6,
    ) -> None:
        super().__init__(believed, confidence, iterations)

    def solve(self, belief: SwarmBelief, inputs: StepInput) -> Solution:
        no_prior = torch.zeros_like(belief.joint.flatten(1, 2))
        return self.posterior(inputs, no_prior, inputs.prior)
