"""DW-MDS: dynamically weighted multidimensional scaling of a swarm (ST-DCL paper, Algorithm 1).

The team's stress is minimized by majorization, warm-started where dead reckoning has carried each
UAV. The paper's window of past ranges is folded into a recursive prior with a joint covariance.
"""

from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from agents.ekf import elapsed
from agents.localizer import register
from agents.swarm import joint
from agents.swarm.filter import Confidence, Found, Prepared, SwarmBelief, SwarmFilter, own_blocks
from agents.swarm.majorization import pull
from coloc_env.scenario import Believed

Covariance = Literal["full", "axes"]
_REFRESH = (0, 2)  # iterations at which weights are made anew
_SELDOM = 10  # and, in the first step, every so many
_FORGOTTEN = 1e-9  # m⁻²: what a prior counts that is not used
_RELAXED = 1.8  # of a step of the Guttman transform, which overestimates how much ranges hold


@register("dwmds_st")
class DynamicMds(SwarmFilter):
    """Whole-team stress majorization with a recursive prior from dead reckoning.

    ``confidence``: how much a link counts: ``em`` by a two-component error model that is fitted to
    the links between UAVs that know where they are, ``huber``, ``paper`` (Huber's, held down by
    what the paper detects), or ``none`` (all alike). ``covariance``: what is kept of what errors
    have in common: ``full``, or one covariance for all ``axes``, at a fraction of the cost, which
    does where UAVs have twenty neighbours and more. ``bias=false`` does not estimate the INS's.
    ``prior=false`` forgets dead reckoning once it has been started from. ``v_max`` (m/s): no UAV is
    said to be faster (the paper's projection). ``iterations`` a step (5; with full covariance 3,
    each with weights of its own), ``first`` in the first (60; 15).
    """

    name = "dwmds_st"

    def __init__(
        self,
        believed: Believed,
        *,
        confidence: Confidence = "em",
        covariance: Covariance = "full",
        bias: bool = True,
        prior: bool = True,
        v_max: float | None = None,
        iterations: int | None = None,
        first: int | None = None,
    ) -> None:
        super().__init__(believed, confidence, bias)
        usual = (3, 15) if covariance == "full" else (5, 60)
        iterations = usual[0] if iterations is None else iterations
        first = max(iterations, usual[1]) if first is None else first
        if not 1 <= iterations <= first:
            raise ValueError(
                f"iterations={iterations}, first={first} is not allowed: 1 ≤ iterations ≤ first"
            )
        if v_max is not None and not v_max > 0:
            raise ValueError(f"v_max={v_max} is not allowed: a speed in m/s > 0")
        self.prior, self.iterations, self.first, self.v_max = prior, iterations, first, v_max
        self.rows = self.process.dim if covariance == "full" else 1
        self.relaxed = 1.0 if self.rows > 1 else _RELAXED

    def joint(self, variance: Float64[Tensor, "B N"]) -> Float64[Tensor, "B N e K"]:
        return joint.independent(variance, self.rows)

    def find(self, belief: SwarmBelief, now: Prepared) -> Found:
        """Algorithm 1's inner loop, and the covariance of what it finds."""
        begins = (belief.step == 0).any(-1)[:, None, None]
        index = joint.moving(now.fixed)
        trust = self.trust(now, index)
        still, distance = now.fixed.unsqueeze(-1), now.links.distance
        y, at, factor = now.place, now, trust
        weight, shift = torch.zeros_like(distance), torch.zeros_like(distance)
        for k in range(self.first if bool(begins.any()) else self.iterations):
            goes_on = begins | (k < self.iterations)  # a world that is not new stops earlier
            if self.rows > 1 or k in _REFRESH or k % _SELDOM == 0:
                if k == _REFRESH[-1] and bool(begins.any()):
                    at = self.nearer(y, weight, trust, now, begins)
                weight, shift = (
                    torch.where(goes_on, new, old)
                    for new, old in zip(self.weigh(y, at), (weight, shift), strict=True)
                )
                factor = self.majorizer(y, weight, trust, now.fixed, index)
            down = torch.where(still, 0.0, pull(y, distance - shift, weight))[:, index]
            down = down + joint.drawn(trust, (now.place - y)[:, index])
            step = self.relaxed * joint.solved(factor, down)
            y = torch.where(goes_on, y.index_add(1, index, step), y)
        if self.v_max is not None:
            y = self.slowed(belief, now, y)
        weight, _ = self.weigh(y, at)
        together = self.known(y, weight, trust, now, index)
        variance = own_blocks(together).diagonal(dim1=-2, dim2=-1).mean(-1)
        return Found(y, variance, together)

    def trust(self, now: Prepared, index: Int64[Tensor, "M"]) -> Float64[Tensor, "B L L"]:
        """What dead reckoning is worth (1/m²) to those in ``index``."""
        if self.prior:
            return joint.precision(joint.among(now.joint, index), now.fixed[:, index])
        forgotten = torch.where(now.fixed, 0.0, _FORGOTTEN)[:, index]
        return joint.independent(forgotten, self.rows).flatten(1, 2)

    def majorizer(
        self,
        y: Float64[Tensor, "B N d"],
        weight: Float64[Tensor, "B N N"],
        trust: Float64[Tensor, "B L L"],
        fixed: Bool[Tensor, "B N"],
        index: Int64[Tensor, "M"],
    ) -> Float64[Tensor, "B L L"]:
        """Cholesky factor of V: the weighted Laplacian (with all components Gauss–Newton's matrix,
        which takes fewer steps where a network bends easily) and what the prior is worth."""
        if self.rows == 1:
            links = joint.laplacian(weight, index)
        else:
            links = joint.of_links(y, weight, self.rows, index)
        return torch.linalg.cholesky_ex(joint.held(links + trust, fixed[:, index])).L

    def known(
        self,
        y: Float64[Tensor, "B N d"],
        weight: Float64[Tensor, "B N N"],
        trust: Float64[Tensor, "B L L"],
        now: Prepared,
        index: Int64[Tensor, "M"],
    ) -> Float64[Tensor, "B N e K"]:
        """The joint covariance of positions."""
        told = joint.of_links(y, self.told(weight, now), self.rows, index)
        part = joint.posterior(told + trust, now.fixed[:, index], now.variance[:, index])
        return joint.whole(part, index, now.variance)

    def nearer(
        self,
        y: Float64[Tensor, "B N d"],
        weight: Float64[Tensor, "B N N"],
        trust: Float64[Tensor, "B L L"],
        now: Prepared,
        begins: Bool[Tensor, "B 1 1"],
    ) -> Prepared:
        """The same for worlds that begin, with what is unsure of where they are by now: a prior of
        many noises' width cannot tell good ranges from bad."""
        together = self.known(y, weight, trust, now, joint.moving(now.fixed))
        return replace(now, between=torch.where(begins, joint.between(together), now.between))

    def slowed(
        self, belief: SwarmBelief, now: Prepared, y: Float64[Tensor, "B N d"]
    ) -> Float64[Tensor, "B N d"]:
        """Algorithm 1's projection (lines 5–11): nobody moves faster than ``v_max``."""
        assert self.v_max is not None
        before = belief.state[..., : self.process.dim]
        reach = self.v_max * elapsed(self.process, belief.step).double().unsqueeze(-1)
        way = y - before
        factor = (reach / way.norm(dim=-1, keepdim=True).clamp_min(1e-9)).clamp_max(1.0)
        held = now.fixed.unsqueeze(-1) | (reach <= 0)
        return torch.where(held, y, before + factor * way)
