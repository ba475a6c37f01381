"""Multidimensional scaling of a network made fully connected (FC-MDS).

The ST-DCL paper gives no formulas, and the text that we have lacks its bibliography. It says:
the network is taken as fully connected, missing distances replaced by shortest paths; all links
count alike; and maps are refined iteratively (sections 2.1 and 5.3). This is our reading of that.
"""

from functools import partial
from typing import Literal

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.swarm.anchored import supports_anchors
from agents.swarm.belief import Solution, StepInput, SwarmBelief, with_finite_prior
from agents.swarm.links import connected, lengths
from agents.swarm.majorization import RELAXATION, iterate, link_descent, require_iterations
from agents.swarm.mds import MdsMap
from agents.swarm.uncertainty import anchor_information, position_variance
from coloc_env.options import PositiveCount
from coloc_env.scenario import Believed


@supports_anchors
class FullyConnectedMds(MdsMap):
    """Majorization in which every pair of a connected component counts alike: measured distances
    stay, missing ones are taken from the map again in every iteration. Anchors stay; no prior.

    ``start``: the first map, ``reckoned`` by dead reckoning, or ``paths``, classical scaling with
    shortest paths in place of missing distances (as in ``mds``, and in the paper). ``iterations``
    a step, ``first`` in the first.
    """

    name = "fcmds"

    def __init__(
        self,
        believed: Believed,
        *,
        start: Literal["reckoned", "paths"] = "reckoned",
        iterations: PositiveCount = 10,
        first: PositiveCount = 60,
    ) -> None:
        super().__init__(believed)
        require_iterations(iterations, first)
        self.start, self.iterations, self.first = start, iterations, first

    def solve(self, belief: SwarmBelief, inputs: StepInput) -> Solution:
        inputs = with_finite_prior(inputs)
        start = Solution(inputs.prior, inputs.variance)
        if self.start == "paths":
            start = super().solve(belief, inputs)
        distance, mask, fixed = inputs.links.distance, inputs.links.mask, inputs.fixed
        component = connected(mask)
        weight, _ = self.weights(start.position, inputs)
        update = partial(
            completed_step, distance=distance, mask=mask, component=component, fixed=fixed
        )
        y = iterate(update, start.position, belief.step, self.iterations, self.first)
        information = anchor_information(y, distance, weight, fixed, inputs.variance, self.std)
        stopping = component.sum(-1).to(torch.float32) / (
            RELAXATION * self.iterations * self.std**2
        )
        return Solution(y, position_variance(information, stopping, start.variance, fixed))


def completed_step(
    y: Float64[Tensor, "B N d"],
    distance: Float64[Tensor, "B N N"],
    mask: Bool[Tensor, "B N N"],
    component: Bool[Tensor, "B N N"],
    fixed: Bool[Tensor, "B N"],
) -> Float64[Tensor, "B N d"]:
    """One over-relaxed Guttman transform of a network whose connected components are complete,
    distances that were not measured taken from y. The stress of the measured ones never rises
    (Kiers, Psychometrika 62, 1997): V = n I − 1 1ᵀ in each component, whatever was measured.
    """
    filled = torch.where(mask, distance, lengths(y))
    complete = component.double()
    step = link_descent(y, filled, complete).masked_fill(fixed.unsqueeze(-1), 0.0)
    count, anchors = complete.sum(-1, keepdim=True), complete @ fixed.double().unsqueeze(-1)
    common = torch.where(anchors > 0, complete @ step / anchors.clamp_min(1.0), 0.0)
    moved = y + RELAXATION * (step + common) / count  # V⁻¹ at the free UAVs
    return torch.where(fixed.unsqueeze(-1), y, moved)
