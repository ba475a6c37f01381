"""MDS-MAP: classical multidimensional scaling of a swarm, snapshot by snapshot."""

import torch

from agents.swarm.anchored import supports_anchors
from agents.swarm.belief import Solution, StepInput, SwarmBelief
from agents.swarm.filter import SwarmFilter
from agents.swarm.scaling import classical_scaling, procrustes, shortest_paths
from coloc_env.scenario import Believed


@supports_anchors
class MdsMap(SwarmFilter):
    """Shortest paths, classical scaling, and the similarity that fits the map to the anchors (to
    dead reckoning of all, where fewer than ``dim`` + 1 anchors are connected).

    Its variance is that of the fit. A UAV without a path to an anchor stays at its prior.
    """

    name = "mds"
    recursive = False

    def __init__(self, believed: Believed) -> None:
        super().__init__(believed, "none")

    def solve(self, belief: SwarmBelief, inputs: StepInput) -> Solution:
        d, prior, fixed = self.process.dim, inputs.prior, inputs.fixed
        paths = shortest_paths(inputs.links.distance, inputs.links.mask)
        finite = paths.isfinite()
        reached = (finite & fixed.unsqueeze(-2)).any(-1)
        longest = torch.where(finite, paths, 0.0).amax((-2, -1), keepdim=True)
        relative = classical_scaling(torch.where(finite, paths, longest), d)
        enough = (fixed.sum(-1, keepdim=True) > d) & reached
        weight = torch.where(enough.any(-1, keepdim=True), fixed & reached, reached).double()
        weight = torch.where(weight.sum(-1, keepdim=True) > 0, weight, 1.0)
        weight = weight * prior.isfinite().all(-1)
        target = prior.nan_to_num(0.0, 0.0, 0.0)
        fitted = procrustes(relative, target, weight)
        squared = ((fitted - target).square().sum(-1) * weight).sum(-1, keepdim=True)
        variance = squared / (d * weight.sum(-1, keepdim=True))
        placed = reached & ~fixed
        return Solution(
            torch.where(placed.unsqueeze(-1), fitted, prior),
            torch.where(placed, variance, inputs.variance),
        )
