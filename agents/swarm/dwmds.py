"""Distributed weighted multidimensional scaling (dwMDS): Costa, Patwari & Hero, "Distributed
weighted-multidimensional scaling for node localization in sensor networks", ACM TOSN 2(1), 2006.
"""

import math
from functools import partial

import torch

from agents.swarm.among_anchors import suited
from agents.swarm.belief import Found, Prepared, SwarmBelief, begun
from agents.swarm.filter import SwarmFilter
from agents.swarm.links import lengths
from agents.swarm.majorization import RELAXED, nodewise, own_pull, repeated, require_iterations
from agents.swarm.spread import spread, told
from agents.swarm.weights import loess
from coloc_env.scenario import Believed


@suited
class CostaMds(SwarmFilter):
    """Each UAV minimizes the stress of its own links, its neighbours held; all at once, sweep after
    sweep (Jacobi, over-relaxed as far as the stress surely falls), from where dead reckoning is.

    Σ W_ij (d_ij − ‖y_i − y_j‖)² + Σ r_i ‖y_i − m_i‖², no robust loss. ``bandwidth``: ranges count
    exp(−d²/h²)/σ², h that many times the longest range at either end (infinite: all alike).
    ``prior_weight``: r_i in units of what the dead-reckoned place m_i deserves, 1 / its variance;
    0 knows no prior. Few sweeps remember the start, too: ``iterations`` a step, ``first`` in the
    first. ``reach`` (m): neighbours are those nearer than that by dead reckoning, not by measured
    range, which would prefer ranges that came out short (their second stage).

    Weights of pairs are those of the team's stress, which makes every sweep lower it. The paper's
    local costs count ranges to anchors twice.
    """

    name = "dwmds"

    def __init__(
        self,
        believed: Believed,
        *,
        bandwidth: float = 2.0,
        prior_weight: float = 1.0,
        reach: float = math.inf,
        iterations: int = 3,
        first: int = 60,
    ) -> None:
        super().__init__(believed, "none")
        if not bandwidth > 0:
            raise ValueError(f"bandwidth={bandwidth} is not allowed: > 0 is needed")
        if not 0 <= prior_weight < math.inf:
            raise ValueError(f"prior_weight={prior_weight} is not allowed: a number ≥ 0 is needed")
        if not reach > 0:
            raise ValueError(f"reach={reach} is not allowed: a distance in m > 0 is needed")
        require_iterations(iterations, first)
        self.bandwidth, self.prior_weight, self.reach = bandwidth, prior_weight, reach
        self.iterations, self.first = iterations, first
        self.recursive = prior_weight > 0

    def find(self, belief: SwarmBelief, now: Prepared) -> Found:
        now = begun(now)
        distance, prior, fixed = now.links.distance, now.place, now.fixed
        near = now.links.mask & (lengths(prior) <= self.reach)
        weight = loess(distance, near, self.bandwidth) / self.std**2
        trust = torch.where(fixed, 0.0, self.prior_weight / now.variance)
        sweep = partial(
            nodewise, distance=distance, weight=weight, prior=prior, trust=trust, fixed=fixed
        )
        y = repeated(sweep, prior, belief.step, self.iterations, self.first)
        information = told(y, distance, weight, fixed, now.variance, self.std)
        start = own_pull(weight, fixed) / (RELAXED * self.iterations)
        return Found(y, spread(information, trust + start, now.variance, fixed))
