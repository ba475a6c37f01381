"""``map`` with learned factors: the ST-GNN's place in the strongest optimizer."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Float64
from tensordict import TensorClass
from torch import Tensor

from agents.bank import BankOptions
from agents.bank.team import TeamBank
from agents.kalman.filter import elapsed
from agents.layers import sigmoid
from agents.localizer import Estimate, Localizer
from agents.registry import NotServed
from agents.stdcl.factors.features import LinkMeans, features, no_means
from agents.stdcl.factors.network import FactorNetwork
from agents.swarm.anchored import is_plain
from agents.swarm.belief import StepInput, SwarmBelief
from agents.swarm.expectation_propagation import Cavity, Sites
from agents.swarm.map import RecursiveMap
from agents.tensorclasses import build
from agents.weights import learned
from coloc_env.observation import Observation
from coloc_env.scenario import Believed, InsDriven
from coloc_env.sensors import Ins, PositionFix, Ranging

_SURE = 1e-6  # smallest probability whose logit is taken


class FactorBelief(TensorClass):
    """``map``'s belief (``base``), running ``means`` of links, what the convolutions have seen
    (``past``), and the logarithm of the factor on the next process noise; batch (B, N)."""

    base: SwarmBelief
    means: LinkMeans
    past: Float[Tensor, "B N K F"]
    log_noise: Float64[Tensor, "B N"]


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
        with torch.no_grad():
            step = self.belief.base.step.double()
            seen, self.means = features(inputs, at, sites, self.belief.means, step, self.std)
        like = self.network.link_out.weight
        *found, past = self.network(
            seen.link.to(like), seen.node.to(like), seen.mask, self.belief.past.to(like)
        )
        self.found = (*(part.double() for part in found), past)


class LearnedFactors(Localizer[FactorBelief]):
    """``map`` (joint biases, expectation propagation) whose factors of ranges a graph network
    corrects.

    From the second pass of each step on, the network gives every link a factor on its weight, a
    shift, and a correction of what is remembered of its NLOS state, and every UAV a factor on its
    next process noise. Without training it is ``map`` itself. Gradients of its parameters reach
    the estimate through the solution, and through covariances and memories those of later steps.

    Raises ValueError for a team with lever arms, anchors or another motion model than an INS's.

    ``weights``: a checkpoint's name or path, or ``none``. ``bank=false``: no falling back to
    ``map`` for UAVs whose ranges that predicts better.
    """

    name = "stdcl_factors"
    centralized = True
    serves = (Ranging, PositionFix)

    def __init__(
        self,
        believed: Believed,
        *,
        weights: str = "stdcl_factors",
        bank: BankOptions = BankOptions(bank=True),  # noqa: B008
    ) -> None:
        super().__init__(believed)
        if not is_plain(believed) or not isinstance(believed.process, InsDriven):
            raise NotServed(
                "a team is needed whose motion an INS drives, with ranges between centres"
            )
        self.base = RecursiveMap(believed)
        self.network = learned(FactorNetwork, weights).double()
        ins = believed.sensor(Ins)
        self.noise = 0.0 if ins is None else ins.std

    @classmethod
    def for_team(
        cls,
        believed: Believed,
        *,
        bank: BankOptions = BankOptions(bank=True),  # noqa: B008
        **options: Any,
    ) -> Localizer[Any]:
        """Learned factors, or a bank of these and ``map``."""
        one = cls(believed, bank=bank, **options)
        return TeamBank(one, RecursiveMap(believed), bank) if bank.bank else one

    def learn(self, network: FactorNetwork) -> None:
        """Correct by this network from now on."""
        self.network = network

    @property
    def exchanges(self) -> bool:
        return True

    def reset(self, observation: Observation) -> FactorBelief:
        base = self.base.reset(observation)
        return build(
            FactorBelief,
            base.batch_size,
            base=base,
            means=no_means(base.variance),
            past=self.network.start(base.batch_size),
            log_noise=torch.zeros_like(base.variance),
        )

    def step(self, belief: FactorBelief, observation: Observation) -> tuple[FactorBelief, Estimate]:
        inputs = self.base.predict(belief.base, observation)
        inputs = self._with_noise(belief, inputs)
        correction = _Correction(self.network, belief, self.base.std)
        solution = self.base.solve(belief.base, inputs, correction)
        *_, memory, log_noise, past = correction.found
        assert solution.outlier is not None
        assert correction.means is not None
        logit = torch.logit(solution.outlier.clamp(_SURE, 1 - _SURE))
        remembered = torch.where(memory == 0, solution.outlier, sigmoid(logit + memory))
        after = build(
            FactorBelief,
            belief.batch_size,
            base=self.base.update(belief.base, inputs, replace(solution, outlier=remembered)),
            means=correction.means,
            past=past.to(belief.past),
            log_noise=log_noise,
        )
        return after, self.base.estimate(inputs, solution)

    def mean(self, belief: FactorBelief) -> Float64[Tensor, "B N S"]:
        return self.base.mean(belief.base)

    def shifted(self, belief: FactorBelief, offset: Float64[Tensor, "B N d"]) -> FactorBelief:
        return belief.replace(base=self.base.shifted(belief.base, offset))

    def diagnostics(self, belief: FactorBelief) -> dict[str, Float64[Tensor, "B N"]]:
        return self.base.diagnostics(belief.base)

    def _with_noise(self, belief: FactorBelief, inputs: StepInput) -> StepInput:
        """The inputs with each free UAV's process noise times its factor."""
        dt = elapsed(self.base.process, belief.base.step).double()
        more = torch.expm1(belief.log_noise) * (dt * self.noise).square()
        more = more.masked_fill(inputs.fixed, 0.0)
        d = self.base.process.dim
        whole = inputs.joint.flatten(1, 2) + more.repeat_interleave(d, -1).diag_embed()
        covariance = whole.unflatten(1, (-1, d))
        pairs = more.unsqueeze(-1) + more.unsqueeze(-2)
        pairs = pairs - (2 * more).diag_embed()
        return replace(
            inputs,
            joint=covariance,
            variance=inputs.variance + more,
            pair_variance=inputs.pair_variance + pairs,
        )
