"""A bank of two branches: a classical one, and a learned one that must predict no worse."""

from typing import Any

import torch
from jaxtyping import Bool, Float, Float64
from tensordict import TensorClass
from torch import Tensor

from agents.bank.branches import Branched, copied, halves, stacked, twice
from agents.bank.evidence import BankOptions, accumulated
from agents.localizer import Estimate, Localizer
from agents.tensorclasses import build
from coloc_env.observation import Observation


class BankBelief(TensorClass):
    """Both branches' beliefs, the ``evidence`` for the candidate (nats), and whether it was
    restarted from the fallback in the last step; batch (B, N)."""

    fallback: Any
    candidate: Any
    evidence: Float64[Tensor, "B N"]
    restarted: Bool[Tensor, "B N"]


class Bank(Localizer[BankBelief]):
    """A filter twice over, as rows of one batch: with Huber's weights (the fallback), and with
    those of its own screen capped by Huber's (the candidate).

    Each UAV speaks with the candidate while the evidence A ≥ 0 that this predicts better what is
    measured; at A < θ the candidate restarts from the fallback with A = 0. What is sent to
    neighbours is what is spoken, and both branches receive the same.
    """

    name = "bank"

    def __init__(self, one: Any, options: BankOptions) -> None:
        """``one``: a filter that weighs its measurements by ``one.screen``, which is replaced."""
        super().__init__(one.believed)
        self.name = one.name  # type: ignore[misc]
        self.filter, self.options = one, options
        self.process, self.models = one.process, one.models
        one.screen = Branched(one.screen, options.degrees)

    @property
    def exchanges(self) -> bool:
        return bool(self.filter.exchanges)

    def learn(self, network: Any) -> None:
        """The candidate judges by this network from now on."""
        self.filter.screen.candidate.network = network

    def reset(self, observation: Observation) -> BankBelief:
        one = self.filter.reset(observation)
        nothing = torch.zeros(one.batch_size, dtype=torch.float64, device=observation.device)
        return BankBelief(
            fallback=one,
            candidate=one.clone(),
            evidence=nothing,
            restarted=nothing > 0,
            batch_size=one.batch_size,
        )

    def step(self, belief: BankBelief, observation: Observation) -> tuple[BankBelief, Estimate]:
        fallback, candidate, evidence, estimates = self.branches(belief, observation)
        restarted = evidence < self.options.restart
        after = build(
            BankBelief,
            belief.batch_size,
            fallback=fallback,
            candidate=copied(restarted, fallback, candidate),
            evidence=evidence.masked_fill(restarted, 0.0),
            restarted=restarted,
        )
        return after, spoken(evidence >= 0, estimates)

    def branches(
        self, belief: BankBelief, observation: Observation
    ) -> tuple[Any, Any, Float64[Tensor, "B N"], Estimate]:
        """A step of both branches: their beliefs (the fallback's first), the evidence with that
        step's, and the estimates of both as rows, first the fallback's."""
        rows = stacked(belief.fallback, belief.candidate)
        rows, estimates = self.filter.step(rows, twice(observation))
        theirs, ours = rows.memory[..., -1].chunk(2)
        evidence = accumulated(belief.evidence, ours, theirs, self.options.forgetting)
        return *halves(rows), evidence, estimates

    def speaks(self, belief: BankBelief) -> Bool[Tensor, "B N"]:
        """Where the candidate is the one that speaks (or spoke in the last step): the evidence is
        for it, and it was not restarted in that step."""
        return (belief.evidence >= 0) & ~belief.restarted

    def mean(self, belief: BankBelief) -> Float[Tensor, "B N S"]:
        ours, theirs = (self.filter.mean(one) for one in (belief.candidate, belief.fallback))
        return torch.where(self.speaks(belief).unsqueeze(-1), ours, theirs)

    def shifted(self, belief: BankBelief, offset: Float[Tensor, "B N d"]) -> BankBelief:
        return belief.replace(
            fallback=self.filter.shifted(belief.fallback, offset),
            candidate=self.filter.shifted(belief.candidate, offset),
        )

    def gaussian(
        self, belief: BankBelief, observation: Observation
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"]]:
        (x, p), (fallback, own) = (
            self.filter.gaussian(one, observation) for one in (belief.candidate, belief.fallback)
        )
        speaks = self.speaks(belief).unsqueeze(-1)
        return torch.where(speaks, x, fallback), torch.where(speaks.unsqueeze(-1), p, own)

    def restart_from(
        self,
        belief: BankBelief,
        rows: Bool[Tensor, "B N"],
        state: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N E E"],
    ) -> BankBelief:
        return belief.replace(
            fallback=self.filter.restart_from(belief.fallback, rows, state, covariance),
            candidate=self.filter.restart_from(belief.candidate, rows, state, covariance),
            evidence=belief.evidence.masked_fill(rows, 0.0),
        )

    def diagnostics(self, belief: BankBelief) -> dict[str, Float[Tensor, "B N"]]:
        speaks = self.speaks(belief)
        ours, theirs = (self.filter.diagnostics(one) for one in (belief.candidate, belief.fallback))
        spoken = {name: torch.where(speaks, ours[name], theirs[name]) for name in ours}
        return spoken | {
            "trust_share": speaks.float(),
            "huber_share": (~speaks).float(),
            "restarts_per_run": belief.restarted.float(),
        }


def spoken(candidate: Bool[Tensor, "B N"], estimates: Estimate) -> Estimate:
    """The estimates of the second half of the rows where the ``candidate`` speaks, those of the
    first elsewhere."""
    parts = {}
    for name in ("position", "velocity", "covariance"):
        theirs, ours = estimates.get(name).chunk(2)
        speaks = candidate.reshape(*candidate.shape, *[1] * (ours.ndim - 2))
        parts[name] = torch.where(speaks, ours, theirs)
    return build(Estimate, candidate.shape, **parts)


def learned_branch(belief: BankBelief) -> Any:
    """The candidate's belief as its filter alone holds it: its screen's own memory."""
    return belief.candidate.replace(memory=belief.candidate.memory[..., :-1])
