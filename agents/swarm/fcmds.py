"""Multidimensional scaling of a network made fully connected (FC-MDS).

The ST-DCL paper gives no formulas, and the text that we have lacks its bibliography. What it says:
the network is taken as fully connected, missing links made by shortest paths; all links count
alike; and maps are refined iteratively (sections 2.1 and 5.3). This is our reading of that.
"""

from functools import partial
from typing import Literal

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.swarm.among_anchors import suited
from agents.swarm.belief import Found, Prepared, SwarmBelief, begun
from agents.swarm.links import connected, lengths
from agents.swarm.majorization import RELAXED, descent, repeated, require_iterations
from agents.swarm.mds import MdsMap
from agents.swarm.spread import spread, told
from coloc_env.scenario import Believed


@suited
class FullyConnectedMds(MdsMap):
    """Majorization in which every pair of a connected part counts alike: measured distances stay,
    missing ones are read off the map anew in every iteration. UAVs with fixes stay; no prior.

    ``start``: the first map, ``reckoned`` where dead reckoning is, or ``paths``, classical scaling
    with shortest paths in place of missing distances (as ``mds`` has it, and as the paper has it).
    ``iterations`` a step, ``first`` in the first.
    """

    name = "fcmds"

    def __init__(
        self,
        believed: Believed,
        *,
        start: Literal["reckoned", "paths"] = "reckoned",
        iterations: int = 10,
        first: int = 60,
    ) -> None:
        super().__init__(believed)
        require_iterations(iterations, first)
        self.start, self.iterations, self.first = start, iterations, first

    def find(self, belief: SwarmBelief, now: Prepared) -> Found:
        now = begun(now)
        begins = Found(now.place, now.variance)
        if self.start == "paths":
            begins = super().find(belief, now)
        distance, fixed, together = now.links.distance, now.fixed, connected(now.links.mask)
        weight, _ = self.weigh(begins.position, now)
        refine = partial(
            completed, distance=distance, mask=now.links.mask, together=together, fixed=fixed
        )
        y = repeated(refine, begins.position, belief.step, self.iterations, self.first)
        information = told(y, distance, weight, fixed, now.variance, self.std)
        kept = together.sum(-1).to(torch.float32) / (RELAXED * self.iterations * self.std**2)
        return Found(y, spread(information, kept, begins.variance, fixed))


def completed(
    y: Float64[Tensor, "B N d"],
    distance: Float64[Tensor, "B N N"],
    mask: Bool[Tensor, "B N N"],
    together: Bool[Tensor, "B N N"],
    fixed: Bool[Tensor, "B N"],
) -> Float64[Tensor, "B N d"]:
    """One over-relaxed Guttman transform of networks whose parts are fully connected, distances
    that were not measured taken from ``y``. The stress of the measured ones never rises (Kiers,
    Psychometrika 62, 1997): V is n I − 1 1ᵀ for each part, whatever was measured.
    """
    nothing = torch.zeros_like(y[..., 0])
    filled = torch.where(mask, distance, lengths(y))
    down = descent(y, filled, together.double(), y, nothing)
    down = down.masked_fill(fixed.unsqueeze(-1), 0.0)
    part = together.double()
    count, fixes = part.sum(-1, keepdim=True), part @ fixed.double().unsqueeze(-1)
    common = torch.where(fixes > 0, part @ down / fixes.clamp_min(1.0), 0.0)
    moved = y + RELAXED * (down + common) / count
    return torch.where(fixed.unsqueeze(-1), y, moved)
