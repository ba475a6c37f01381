"""Velocity-assisted multidimensional scaling (vMDS): a snapshot's stress and a velocity term.

After the ST-DCL paper, which calls it a time smoothness constraint (section 2.1); its equation 19
without window and confidence.
"""

from functools import partial
from typing import Annotated

import torch

from agents.swarm.anchored import supports_anchors
from agents.swarm.belief import Solution, StepInput, SwarmBelief, with_finite_prior
from agents.swarm.confidence import ConfidenceKind
from agents.swarm.filter import SwarmFilter
from agents.swarm.majorization import guttman_step, iterate, majorizer, require_iterations
from agents.swarm.uncertainty import anchor_information, position_variance
from coloc_env.options import PositiveCount, Quantity
from coloc_env.scenario import Believed

_REWEIGHTED = 2  # times in a step


@supports_anchors
class VelocityMds(SwarmFilter):
    """Σ W_ij (d_ij − ‖p_i − p_j‖)² + λ_s Σ ‖(p_i(t) − p_i(t−1))/Δt − v_i‖² over p(t), with v the
    INS's velocity (that of dead reckoning, without an INS), by majorization for the whole team.

    ``velocity_weight``: λ_s in s²/m², the same for all UAVs at all times; in the first step, which
    has no velocity, the prior counts by its variance instead. ``confidence``: ``huber``, or
    ``none`` or ``em``, as ``dwmds_st`` has it. ``iterations`` after each of a step's two
    reweightings, ``first`` in the first step.
    """

    name = "vmds"

    def __init__(
        self,
        believed: Believed,
        *,
        velocity_weight: Annotated[float, Quantity("s²/m²", above=0.0)] = 0.1,
        confidence: ConfidenceKind = "huber",
        iterations: PositiveCount = 3,
        first: PositiveCount = 30,
    ) -> None:
        super().__init__(believed, confidence)
        require_iterations(iterations, first)
        self.velocity_weight, self.iterations, self.first = velocity_weight, iterations, first

    def solve(self, belief: SwarmBelief, inputs: StepInput) -> Solution:
        inputs = with_finite_prior(inputs)
        y, prior, fixed = inputs.prior, inputs.prior, inputs.fixed
        usual = self.velocity_weight / self.process.dt**2  # λ_s / Δt²
        precision = torch.where(belief.step == 0, 1 / inputs.variance, usual)
        precision = precision.masked_fill(fixed, 0.0)
        for _ in range(_REWEIGHTED):
            weight, shift = self.weights(y, inputs)
            distance, factor = inputs.links.distance - shift, majorizer(weight, precision, fixed)
            update = partial(
                guttman_step,
                distance=distance,
                weight=weight,
                prior=prior,
                precision=precision,
                fixed=fixed,
                factor=factor,
            )
            y = iterate(update, y, belief.step, self.iterations, self.first)
        information = anchor_information(y, distance, weight, fixed, inputs.variance, self.std)
        return Solution(y, position_variance(information, precision, inputs.variance, fixed))
