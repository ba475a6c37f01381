"""MDS-MAP: classical multidimensional scaling of a swarm, snapshot by snapshot."""

import torch

from agents.swarm.among_anchors import suited
from agents.swarm.belief import Found, Prepared, SwarmBelief
from agents.swarm.filter import SwarmFilter
from agents.swarm.scaling import aligned, classical_scaling, shortest_paths
from coloc_env.scenario import Believed


@suited
class MdsMap(SwarmFilter):
    """Shortest paths, classical scaling, and the turn, mirror and shift that fit UAVs with fixes
    (everybody's dead reckoning, where fewer than ``dim`` + 1 are connected).

    Its variance is that of those fits. A UAV without a path to a fix stays where it was.
    """

    name = "mds"
    recursive = False

    def __init__(self, believed: Believed) -> None:
        super().__init__(believed, "none")

    def find(self, belief: SwarmBelief, now: Prepared) -> Found:
        d = self.process.dim
        paths = shortest_paths(now.links.distance, now.links.mask)
        finite = paths.isfinite()
        reached = (finite & now.fixed.unsqueeze(-2)).any(-1)
        longest = torch.where(finite, paths, 0.0).amax((-2, -1), keepdim=True)
        shape = classical_scaling(torch.where(finite, paths, longest), d)
        enough = (now.fixed.sum(-1, keepdim=True) > d) & reached
        weight = torch.where(enough.any(-1, keepdim=True), now.fixed & reached, reached).double()
        weight = torch.where(weight.sum(-1, keepdim=True) > 0, weight, 1.0)
        weight = weight * now.place.isfinite().all(-1)
        place = now.place.nan_to_num(0.0, 0.0, 0.0)
        found = aligned(shape, place, weight)
        off = ((found - place).square().sum(-1) * weight).sum(-1, keepdim=True)
        variance = off / (d * weight.sum(-1, keepdim=True))
        moves = reached & ~now.fixed
        return Found(
            torch.where(moves.unsqueeze(-1), found, now.place),
            torch.where(moves, variance, now.variance),
        )
