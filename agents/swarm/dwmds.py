"""Distributed weighted multidimensional scaling (dwMDS): Costa, Patwari & Hero, "Distributed
weighted-multidimensional scaling for node localization in sensor networks", ACM TOSN 2(1), 2006.
"""

import math
from functools import partial
from typing import Annotated

import torch

from agents.swarm.anchored import supports_anchors
from agents.swarm.belief import Solution, StepInput, SwarmBelief, with_finite_prior
from agents.swarm.filter import SwarmFilter
from agents.swarm.links import lengths
from agents.swarm.majorization import (
    RELAXATION,
    iterate,
    jacobi_diagonal,
    jacobi_step,
    require_iterations,
)
from agents.swarm.uncertainty import anchor_information, position_variance
from agents.swarm.weights import loess
from coloc_env.options import PositiveCount, Quantity
from coloc_env.scenario import Believed


@supports_anchors
class CostaMds(SwarmFilter):
    """Each UAV minimizes the stress of its own links, its neighbours held; all at once, sweep after
    sweep (over-relaxed Jacobi iterations), from the positions of dead reckoning.

    S(y) = Σ W_ij (d_ij − ‖y_i − y_j‖)² + Σ r_i ‖y_i − m_i‖², no robust loss. ``bandwidth``:
    W_ij = exp(−d²/h²)/σ², h that many times the longest range at either end (infinite: all alike).
    ``prior_weight``: r_i in units of 1/P_i, P_i the variance of the dead-reckoned position m_i; 0:
    no prior. Few sweeps regularize towards the start as well: ``iterations`` a step, ``first`` in
    the first. ``reach`` (m): neighbours are those nearer than that by dead reckoning, not by
    measured range, which would prefer ranges that are too short (their second stage).

    Weights of pairs are those of the team's stress, which makes every sweep lower it. The paper's
    local costs count ranges to anchors twice.
    """

    name = "dwmds"

    def __init__(
        self,
        believed: Believed,
        *,
        bandwidth: Annotated[float, Quantity(above=0.0, infinite=True)] = 2.0,
        prior_weight: Annotated[float, Quantity(least=0.0)] = 1.0,
        reach: Annotated[float, Quantity("m", above=0.0, infinite=True)] = math.inf,
        iterations: PositiveCount = 3,
        first: PositiveCount = 60,
    ) -> None:
        super().__init__(believed, "none")
        require_iterations(iterations, first)
        self.bandwidth, self.prior_weight, self.reach = bandwidth, prior_weight, reach
        self.iterations, self.first = iterations, first
        self.recursive = prior_weight > 0

    def solve(self, belief: SwarmBelief, inputs: StepInput) -> Solution:
        inputs = with_finite_prior(inputs)
        distance, prior, fixed = inputs.links.distance, inputs.prior, inputs.fixed
        near = inputs.links.mask & (lengths(prior) <= self.reach)
        weight = loess(distance, near, self.bandwidth) / self.std**2  # W_ij
        precision = torch.where(fixed, 0.0, self.prior_weight / inputs.variance)  # r_i
        sweep = partial(
            jacobi_step,
            distance=distance,
            weight=weight,
            prior=prior,
            precision=precision,
            fixed=fixed,
        )
        y = iterate(sweep, prior, belief.step, self.iterations, self.first)
        information = anchor_information(y, distance, weight, fixed, inputs.variance, self.std)
        stopping = jacobi_diagonal(weight, fixed) / (RELAXATION * self.iterations)
        variance = position_variance(information, precision + stopping, inputs.variance, fixed)
        return Solution(y, variance)
