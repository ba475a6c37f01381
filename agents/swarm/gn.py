"""References for swarms that keep all correlations of a team: the snapshot's and the recursive one.

Gauss–Newton over the joint position of all UAVs, without a prior (``gn``) and with the joint
covariance that dead reckoning has carried on (``map``).
"""

import torch

from agents.swarm.among_anchors import suited
from agents.swarm.belief import Found, Prepared, SwarmBelief
from agents.swarm.filter import Confidence
from agents.swarm.joint_solution import JointSolution
from coloc_env.scenario import Believed

_AGAIN = 3  # times that a first step is solved once more


@suited
class Snapshot(JointSolution):
    """Gauss–Newton on the ranges of one step, started where dead reckoning is. ``confidence``:
    ``huber``, ``em`` or ``none``, as ``dwmds_st`` has it."""

    name = "gn"
    recursive = False

    def __init__(
        self, believed: Believed, *, confidence: Confidence = "huber", iterations: int = 6
    ) -> None:
        super().__init__(believed, confidence, iterations)

    def find(self, belief: SwarmBelief, now: Prepared) -> Found:
        return self.solved(now, torch.zeros_like(belief.joint.flatten(1, 2)), now.place)
