"""DW-MDS: dynamically weighted multidimensional scaling of a swarm (ST-DCL paper, Algorithm 1).

The team's stress is minimized by majorization, warm-started where dead reckoning has carried each
UAV. The paper's window of past ranges is folded into a recursive prior with its own variance.
"""

import torch

from agents.localizer import register
from agents.swarm.filter import Confidence, Found, Prepared, SwarmBelief, SwarmFilter
from agents.swarm.majorization import guttman, majorizer
from coloc_env.scenario import Believed

_REFRESH = (0, 2)  # iterations at which weights are made anew
_SELDOM = 10  # and, in the first step, every so many
_FORGOTTEN = 1e-9  # m⁻²: what a prior counts that is not used


@register("dwmds_st")
class DynamicMds(SwarmFilter):
    """Whole-team stress majorization with a recursive prior from dead reckoning.

    ``confidence``: how much a link counts: ``em`` by a two-component error model that is fitted to
    the links between UAVs that know where they are, ``huber``, or ``none`` (all alike).
    ``prior=false`` forgets dead reckoning once it has been started from. ``iterations`` a step,
    ``first`` in the first.
    """

    name = "dwmds_st"

    def __init__(
        self,
        believed: Believed,
        *,
        confidence: Confidence = "em",
        prior: bool = True,
        iterations: int = 5,
        first: int = 60,
    ) -> None:
        super().__init__(believed, confidence)
        if not 1 <= iterations <= first:
            raise ValueError(
                f"iterations={iterations}, first={first} is not allowed: 1 ≤ iterations ≤ first"
            )
        self.prior, self.iterations, self.first = prior, iterations, first

    def find(self, belief: SwarmBelief, now: Prepared) -> Found:
        """Algorithm 1's inner loop, and the variance 1 / (½ Σ W/d + λ) of what it finds."""
        begins = (belief.step == 0).any(-1)[:, None, None]
        trust = 1 / now.variance if self.prior else torch.full_like(now.variance, _FORGOTTEN)
        trust = torch.where(now.fixed, 0.0, trust)
        y, distance = now.place, now.links.distance
        weight, shift = torch.zeros_like(distance), torch.zeros_like(distance)
        factor = weight
        for k in range(self.first if bool(begins.any()) else self.iterations):
            goes_on = begins | (k < self.iterations)  # a world that is not new stops earlier
            if k in _REFRESH or k % _SELDOM == 0:
                weight, shift = (
                    torch.where(goes_on, new, old)
                    for new, old in zip(self.weigh(y, now), (weight, shift), strict=True)
                )
                factor = majorizer(weight, trust, now.fixed)
            moved = guttman(y, distance - shift, weight, now.place, trust, now.fixed, factor)
            y = torch.where(goes_on, moved, y)
        told = 0.5 * weight.sum(-1) / self.process.dim + trust
        variance = torch.where(now.fixed, now.variance, 1 / told.clamp_min(_FORGOTTEN))
        return Found(y, variance)
