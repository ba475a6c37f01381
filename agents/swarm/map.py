"""References for swarms that keep all correlations of a team: the snapshot's and the recursive one.

Gauss–Newton over the joint position of all UAVs, without a prior (``gn``) and with the joint
covariance that dead reckoning has carried on (``map``).
"""

from dataclasses import replace

import torch

from agents.swarm import delays, joint
from agents.swarm.among_anchors import suited
from agents.swarm.belief import Found, Prepared, SwarmBelief
from agents.swarm.filter import Confidence
from agents.swarm.gauss_newton import coordinates
from agents.swarm.joint_solution import JointSolution
from agents.swarm.obstruction import unsure
from coloc_env.scenario import Believed

_AGAIN = 3  # times that a first step is solved once more


@suited
class RecursiveMap(JointSolution):
    """Recursive maximum a posteriori with the team's full covariance. ``confidence``: ``em``,
    ``huber`` or ``none``, and ``bias``, as ``dwmds_st`` has them. ``delays=false`` does not
    estimate what clocks and antennas add to ranges.

    In a swarm's first step ranges are weighed anew by what is unsure of where UAVs are by then: a
    prior of many noises' width cannot tell good ranges from bad. Few links could agree on a wrong
    place: where they are not dense, the first weights stay."""

    name = "map"

    def __init__(
        self,
        believed: Believed,
        *,
        confidence: Confidence = "em",
        iterations: int = 3,
        bias: bool = True,
        delays: bool = True,
    ) -> None:
        super().__init__(believed, confidence, iterations, bias, delays)

    def find(self, belief: SwarmBelief, now: Prepared) -> Found:
        whole = delays.whole(now.joint, now.delays)
        still = coordinates(now.fixed, self.process.dim, whole.shape[-1])
        known = joint.held_by(whole, still)
        found = self.solved(now, known, now.place)
        begins = (belief.step == 0).any(-1)[:, None, None]
        for _ in range(_AGAIN if self.dense and bool(begins.any()) else 0):
            between = torch.where(begins, unsure(now, found), now.between)
            now = replace(now, between=between)
            found = self.solved(now, known, torch.where(begins, found.position, now.place))
        return found
