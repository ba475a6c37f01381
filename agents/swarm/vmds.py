"""Velocity-assisted multidimensional scaling (vMDS): a snapshot's stress and a velocity term.

After the ST-DCL paper, which calls it a time smoothness constraint (section 2.1); its equation 19
without window and confidence.
"""

import math
from functools import partial

import torch

from agents.swarm.among_anchors import suited
from agents.swarm.belief import Found, Prepared, SwarmBelief, begun
from agents.swarm.filter import Confidence, SwarmFilter
from agents.swarm.majorization import guttman, majorizer, repeated, require_iterations
from agents.swarm.spread import spread, told
from coloc_env.scenario import Believed

_ROUNDS = 2  # of weights in a step


@suited
class VelocityMds(SwarmFilter):
    """Σ W_ij (d_ij − ‖p_i − p_j‖)² + λ_s Σ ‖(p_i(t) − p_i(t−1))/Δt − v_i‖² over p(t), with v what
    the INS says (dead reckoning's step, where there is none), by majorization of the whole team.

    ``velocity_weight``: λ_s in s²/m², the same for all UAVs at all times; in the first step, which
    has no velocity, the prior counts by its variance instead. ``confidence``: ``huber``, or
    ``none`` or ``em``, as ``dwmds_st`` has it. ``iterations`` for each of a step's two rounds of
    weights, ``first`` in the first step.
    """

    name = "vmds"

    def __init__(
        self,
        believed: Believed,
        *,
        velocity_weight: float = 0.1,
        confidence: Confidence = "huber",
        iterations: int = 3,
        first: int = 30,
    ) -> None:
        super().__init__(believed, confidence)
        if not 0 < velocity_weight < math.inf:
            raise ValueError(f"velocity_weight={velocity_weight} is not allowed: > 0 s²/m²")
        require_iterations(iterations, first)
        self.velocity_weight, self.iterations, self.first = velocity_weight, iterations, first

    def find(self, belief: SwarmBelief, now: Prepared) -> Found:
        now = begun(now)
        y, prior, fixed = now.place, now.place, now.fixed
        usual = self.velocity_weight / self.process.dt**2
        trust = torch.where(belief.step == 0, 1 / now.variance, usual).masked_fill(fixed, 0.0)
        for _ in range(_ROUNDS):
            weight, shift = self.weigh(y, now)
            distance, factor = now.links.distance - shift, majorizer(weight, trust, fixed)
            move = partial(
                guttman,
                distance=distance,
                weight=weight,
                prior=prior,
                trust=trust,
                fixed=fixed,
                factor=factor,
            )
            y = repeated(move, y, belief.step, self.iterations, self.first)
        information = told(y, distance, weight, fixed, now.variance, self.std)
        return Found(y, spread(information, trust, now.variance, fixed))
