"""DW-MDS: dynamically weighted multidimensional scaling of a swarm (ST-DCL paper, Algorithm 1).

The team's stress is minimized by majorization, warm-started where dead reckoning has carried each
UAV. The paper's window of past ranges is folded into a recursive prior with a joint covariance,
or kept as it is (``window``).
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from agents.kalman.filter import elapsed
from agents.swarm import joint, window
from agents.swarm.among_anchors import suited
from agents.swarm.belief import Found, Prepared, SwarmBelief
from agents.swarm.filter import Confidence, SwarmFilter
from agents.swarm.majorization import pull, require_iterations
from coloc_env.scenario import Believed

_REFRESH = (0, 2)  # iterations at which weights are made anew
_SELDOM = 10  # and, in the first step, every so many
_FORGOTTEN = 1e-9  # m⁻²: what a prior counts that is not used
_RELAXED = 1.8  # of a Guttman step, which overestimates how much many ranges hold together


@suited
class DynamicMds(SwarmFilter):
    """Whole-team stress majorization with a recursive prior from dead reckoning.

    What errors have in common is kept as one covariance for all axes, which does where UAVs have
    twenty neighbours and more that surround them; ``map`` keeps all of it, at three times the cost.

    ``confidence``: how much a link counts: ``em`` by a two-component error model that is fitted to
    the links between UAVs that know where they are, ``huber``, ``paper`` (Huber's, held down by
    what the paper detects), or ``none`` (all alike). ``bias=false`` does not estimate the INS's.
    ``prior=false`` forgets dead reckoning once it has been started from. ``v_max`` (m/s): no UAV is
    said to be faster (the paper's projection). ``iterations`` a step, ``first`` in the first.

    ``window``: the stress sums over the links of as many past steps, too, each where dead reckoning
    says it was, with weights exp(−λ age), λ the ``decay`` in 1/s; the prior is then what was known
    before the oldest of them. The paper's T is min(T_max, ⌈√(2R/a_max)/Δt⌉), R the radius of
    communication. Displacements are held to be exact, their errors are what ``decay`` stands for.
    """

    name = "dwmds_st"

    def __init__(
        self,
        believed: Believed,
        *,
        confidence: Confidence = "em",
        bias: bool = True,
        prior: bool = True,
        v_max: float | None = None,
        window: int = 0,
        decay: float = 0.05,
        iterations: int = 5,
        first: int = 60,
    ) -> None:
        super().__init__(believed, confidence, bias)
        require_iterations(iterations, first)
        if v_max is not None and not v_max > 0:
            raise ValueError(f"v_max={v_max} is not allowed: a speed in m/s > 0")
        if window < 0:
            raise ValueError(f"window={window} is not allowed: a number of steps ≥ 0")
        if not 0 <= decay < math.inf:
            raise ValueError(f"decay={decay} is not allowed: a rate in 1/s ≥ 0")
        self.prior, self.iterations, self.first, self.v_max = prior, iterations, first, v_max
        self.window, self.decay = window, decay
        self.recursive = prior

    def joint(self, variance: Float64[Tensor, "B N"]) -> Float64[Tensor, "B N e K"]:
        return joint.independent(variance, 1)

    def find(self, belief: SwarmBelief, now: Prepared) -> Found:
        """Algorithm 1's inner loop, and the covariance of what it finds."""
        begins = (belief.step == 0).any(-1)[:, None, None]
        index = joint.moving(now.fixed)
        place, known = (now.place, now.joint) if now.past is None else window.before(now.past)
        trust = self.trust(known, now.fixed, index)
        holds = informs = trust
        if now.past is not None:
            holds = trust + joint.laplacian(now.past.weight.sum(2), index)
            informs = trust + joint.laplacian(now.past.told.sum(2) / self.process.dim, index)
        still, distance = now.fixed.unsqueeze(-1), now.links.distance
        y, at, factor = now.place, now, trust
        weight, shift = torch.zeros_like(distance), torch.zeros_like(distance)
        relaxed = _RELAXED if self.dense else 1.0
        for k in range(self.first if bool(begins.any()) else self.iterations):
            goes_on = begins | (k < self.iterations)  # a world that is not new stops earlier
            if k in _REFRESH or k % _SELDOM == 0:
                if k == _REFRESH[-1] and bool(begins.any()):
                    at = self.nearer(weight, informs, now, begins)
                weight, shift = (
                    torch.where(goes_on, new, old)
                    for new, old in zip(self.weigh(y, at), (weight, shift), strict=True)
                )
                links = joint.laplacian(weight, index)
                factor = torch.linalg.cholesky_ex(joint.held(links + holds, now.fixed[:, index])).L
            down = pull(y, distance - shift, weight)
            if now.past is not None:
                down = down + window.pull(y, now.past)
            down = torch.where(still, 0.0, down)[:, index]
            down = down + trust @ (place - y)[:, index]
            step = relaxed * torch.cholesky_solve(down, factor)
            y = torch.where(goes_on, y.index_add(1, index, step), y)
        if self.v_max is not None:
            y = self.slowed(belief, now, y)
        weight, shift = self.weigh(y, at)
        together = self.known(weight, informs, now, index)
        past = now.past
        if past is not None:
            told = self.told(weight, now)
            past = window.pushed(past, now.place, now.joint, distance - shift, weight, told)
        return Found(y, joint.variances(together), together, past)

    def trust(
        self,
        known: Float64[Tensor, "B N e K"],
        fixed: Bool[Tensor, "B N"],
        index: Int64[Tensor, "M"],
    ) -> Float64[Tensor, "B L L"]:
        """What dead reckoning is worth (1/m²) to those in ``index``."""
        if self.prior:
            return joint.precision(joint.among(known, index), fixed[:, index])
        return torch.diag_embed(_FORGOTTEN * (~fixed[:, index]).double())

    def known(
        self,
        weight: Float64[Tensor, "B N N"],
        trust: Float64[Tensor, "B L L"],
        now: Prepared,
        index: Int64[Tensor, "M"],
    ) -> Float64[Tensor, "B N e K"]:
        """The joint covariance of positions."""
        told = joint.laplacian(self.told(weight, now) / self.process.dim, index)
        part = joint.posterior(told + trust, now.fixed[:, index], now.variance[:, index])
        return joint.whole(part, index, now.variance)

    def nearer(
        self,
        weight: Float64[Tensor, "B N N"],
        trust: Float64[Tensor, "B L L"],
        now: Prepared,
        begins: Bool[Tensor, "B 1 1"],
    ) -> Prepared:
        """The same for worlds that begin, with what is unsure of where they are by now: a prior of
        many noises' width cannot tell good ranges from bad."""
        together = self.known(weight, trust, now, joint.moving(now.fixed))
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
