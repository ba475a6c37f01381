"""``stdcl``: the ST-GNN's place in the strongest optimizer, ``map`` with learned factors."""

from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, Literal

import torch
from jaxtyping import Float, Float64
from tensordict import TensorClass
from torch import Tensor
from torch.nn.functional import pad

from agents.bank import BankOptions
from agents.bank.team import TeamBank
from agents.kalman.filter import elapsed
from agents.layers import sigmoid
from agents.localizer import Localizer
from agents.stdcl.factors.features import LinkMeans, features, no_means
from agents.stdcl.factors.network import FactorNetwork
from agents.stdcl.variants import LoopOptions, StDclLoop
from agents.swarm.anchored import AnchoredTeam, is_plain
from agents.swarm.belief import Solution, StepInput, SwarmBelief
from agents.swarm.expectation_propagation import Cavity, Sites
from agents.swarm.links import of_both_ends
from agents.swarm.map import Adjust, RecursiveMap
from agents.tensorclasses import build
from agents.weights import learned
from coloc_env.observation import Observation
from coloc_env.scenario import Believed, InsDriven
from coloc_env.sensors import Ins

_SURE = 1e-6  # smallest probability whose logit is taken
_LOOP = LoopOptions()
_NO_BANK = BankOptions(bank=False)


class FactorMemory(TensorClass):
    """Running ``means`` of links, what the convolutions have seen (``past``), and the logarithm of
    the factor on the next process noise; batch (B, N)."""

    means: LinkMeans
    past: Float[Tensor, "B N K F"]
    log_noise: Float64[Tensor, "B N"]


class FactorBelief(SwarmBelief):
    """``map``'s belief, and what the network remembers (``memory``); batch (B, N)."""

    memory: FactorMemory


@dataclass(frozen=True)
class FactorSolution(Solution):
    """``map``'s solution, and what the network remembers after it."""

    memory: FactorMemory | None = None


@dataclass
class _Correction:
    """The network's word on a step's sites, which it gives once, at the second pass."""

    network: FactorNetwork
    belief: FactorBelief
    std: float
    found: tuple[Tensor, ...] = ()
    means: LinkMeans | None = None

    def __call__(self, k: int, inputs: StepInput, at: Cavity, sites: Sites) -> Sites:
        """The first pass of expectation propagation is map's own."""
        if k == 0:
            return sites
        if k == 1:
            self._judge(inputs, at, sites)
        log_weight, shift = self.found[:2]
        return replace(
            sites,
            weight=sites.weight * log_weight.exp(),
            shift=sites.shift + self.std * shift,
        )

    def _judge(self, inputs: StepInput, at: Cavity, sites: Sites) -> None:
        memory = self.belief.memory
        with torch.no_grad():
            step = self.belief.step.double()
            seen, self.means = features(inputs, at, sites, memory.means, step, self.std)
        like = self.network.link_out.weight
        *found, past = self.network(
            seen.link.to(like), seen.node.to(like), seen.mask, memory.past.to(like)
        )
        self.found = (*(part.double() for part in found), past)


class StDcl(RecursiveMap):
    """ST-DCL: an optimizer and a graph network that has a say in it.

    ``variant=factors``: ``map`` (joint biases, expectation propagation), whose factors of ranges
    the network corrects. From the second pass of each step on, it gives every link a factor on its
    weight, a shift, and a correction of what is remembered of its NLOS state, and every UAV a
    factor on its next process noise. Without training it is ``map`` itself. Gradients of the
    network's parameters reach the estimate through the solution, and through covariances and
    memories those of later steps.

    ``variant=calibrated`` and ``paper``: ``dwmds_st``, a network that corrects its positions, and
    the loop between them, for teams whose motion an INS drives and whose ranges are between
    centres. ``calibrated``: weights of links by the errors that links between anchors show, and a
    feedback that is learned; ``paper``: Huber's loss times equation 17, and the feedback of
    equation 36.

    ``weights``: a checkpoint's name or path, or ``none``; not given, the variant's own.
    ``bank=true`` falls back to ``map`` for UAVs whose ranges that predicts better.
    """

    name = "stdcl"

    def __init__(
        self,
        believed: Believed,
        *,
        variant: Literal["factors", "calibrated", "paper"] = "factors",
        weights: str | None = None,
        loop: LoopOptions = _LOOP,
        bank: BankOptions = _NO_BANK,
    ) -> None:
        super().__init__(believed)
        self.network = learned(FactorNetwork, weights or "stdcl").double()
        ins = believed.sensor(Ins) if isinstance(believed.process, InsDriven) else None
        self.noise = 0.0 if ins is None else ins.std  # m/s

    @classmethod
    def for_team(
        cls,
        believed: Believed,
        *,
        variant: Literal["factors", "calibrated", "paper"] = "factors",
        weights: str | None = None,
        loop: LoopOptions = _LOOP,
        bank: BankOptions = _NO_BANK,
    ) -> Localizer[Any]:
        """The variant, or a bank of it and ``map``."""
        if variant != "factors":
            one: Any = StDclLoop(believed, variant, weights, loop)
        elif loop != _LOOP:
            given = [x.name for x in fields(loop) if getattr(loop, x.name) != x.default]
            raise ValueError(f"{', '.join(given)}: for variant=calibrated or paper alone")
        elif is_plain(believed):
            one = cls(believed, weights=weights)
        elif bank.bank:
            raise ValueError("bank=true is for teams whose motion an INS drives, without anchors")
        else:
            return AnchoredTeam(believed, partial(cls, weights=weights))
        return TeamBank(one, RecursiveMap(believed), bank) if bank.bank else one

    def learn(self, network: FactorNetwork) -> None:
        """Correct by this network from now on."""
        self.network = network

    def reset(self, observation: Observation) -> FactorBelief:
        base = super().reset(observation)
        memory = build(
            FactorMemory,
            base.batch_size,
            means=no_means(base.variance),
            past=self.network.start(base.batch_size),
            log_noise=torch.zeros_like(base.variance),
        )
        return _with_memory(base, memory)

    def predict(self, belief: SwarmBelief, observation: Observation) -> StepInput:
        """Dead reckoning, with each free UAV's process noise times its factor."""
        assert isinstance(belief, FactorBelief)
        inputs = super().predict(belief, observation)
        dt = elapsed(self.process, belief.step).double()
        more = torch.expm1(belief.memory.log_noise) * (dt * self.noise).square()
        more = more.masked_fill(inputs.fixed, 0.0)
        d = self.process.dim
        whole = inputs.joint.flatten(1, 2) + more.repeat_interleave(d, -1).diag_embed()
        pairs = more.unsqueeze(-1) + more.unsqueeze(-2)
        pairs = pairs - (2 * more).diag_embed()
        return replace(
            inputs,
            joint=whole.unflatten(1, (-1, d)),
            variance=inputs.variance + more,
            pair_variance=inputs.pair_variance + pairs,
        )

    def solve(
        self, belief: SwarmBelief, inputs: StepInput, adjust: Adjust | None = None
    ) -> FactorSolution:
        assert isinstance(belief, FactorBelief)
        correction = _Correction(self.network, belief, self.std)
        solution = super().solve(belief, inputs, correction)
        *_, logit, log_noise, past = correction.found
        assert solution.outlier is not None
        own = torch.logit(solution.outlier.clamp(_SURE, 1 - _SURE))
        outlier = torch.where(logit == 0, solution.outlier, sigmoid(own + logit))
        memory = build(
            FactorMemory,
            belief.batch_size,
            means=correction.means,
            past=past.to(belief.memory.past),
            log_noise=log_noise,
        )
        parts = vars(replace(solution, outlier=outlier))
        return FactorSolution(**parts, memory=memory)

    def update(self, belief: SwarmBelief, inputs: StepInput, solution: Solution) -> FactorBelief:
        assert isinstance(solution, FactorSolution)
        assert solution.memory is not None
        return _with_memory(super().update(belief, inputs, solution), solution.memory)

    def of_members(self, belief: SwarmBelief, count: int) -> FactorBelief:
        assert isinstance(belief, FactorBelief)
        members, own = super().of_members(belief, count), belief.memory
        started = self.network.start(torch.Size((len(belief), count))).to(own.past)
        memory = build(
            FactorMemory,
            members.batch_size,
            means=build(
                LinkMeans,
                members.batch_size,
                **{name: of_both_ends(value) for name, value in own.means.items()},
            ),
            past=torch.cat((own.past, started), 1),
            log_noise=pad(own.log_noise, (0, count)),
        )
        return _with_memory(members, memory)


def _with_memory(base: SwarmBelief, memory: FactorMemory) -> FactorBelief:
    parts = {name: getattr(base, name) for name in SwarmBelief.__dataclass_fields__}
    return build(FactorBelief, base.batch_size, **parts, memory=memory)
