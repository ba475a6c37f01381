"""A bank of two different methods side by side, each with a belief of its own kind."""

from abc import abstractmethod
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from agents.bank.bank import BankBelief, spoken
from agents.bank.branches import stacked
from agents.bank.evidence import LARGEST, BankOptions, accumulated
from agents.localizer import Estimate, Localizer
from agents.tensorclasses import build
from coloc_env.observation import Observation


class SideBySide(Localizer[BankBelief]):
    """Each UAV speaks with the candidate while the evidence A > 3 that this predicts better what is
    measured: more than one step can say, because unlike two branches of one filter these differ
    from the first step on. At A < θ it restarts from the fallback, with A = 0. Both receive the
    same."""

    shares: ClassVar[tuple[str, str]]
    """Names of the shares of time in which the candidate and the fallback speak."""

    def __init__(self, candidate: Any, fallback: Any, options: BankOptions) -> None:
        super().__init__(candidate.believed)
        self.name = candidate.name  # type: ignore[misc]
        self.candidate, self.fallback, self.options = candidate, fallback, options

    @property
    def exchanges(self) -> bool:
        return bool(self.candidate.exchanges)

    def reset(self, observation: Observation) -> BankBelief:
        fallback = self.fallback.reset(observation)
        nothing = torch.zeros(fallback.batch_size, dtype=torch.float64, device=observation.device)
        return BankBelief(
            fallback=fallback,
            candidate=self.candidate.reset(observation),
            evidence=nothing,
            restarted=nothing > 0,
            batch_size=fallback.batch_size,
        )

    def step(self, belief: BankBelief, observation: Observation) -> tuple[BankBelief, Estimate]:
        fallback, classical = self.fallback.step(belief.fallback, observation)
        candidate, learned = self.candidate.step(belief.candidate, observation)
        after = belief.replace(fallback=fallback, candidate=candidate)
        ours, theirs = self.scores(belief, after, observation)
        evidence = accumulated(belief.evidence, ours, theirs, self.options.forgetting)
        rows = evidence < self.options.restart
        if bool(rows.any()):
            candidate = self.restarted(after, rows, observation)
        after = build(
            BankBelief,
            belief.batch_size,
            fallback=fallback,
            candidate=candidate,
            evidence=evidence.masked_fill(rows, 0.0),
            restarted=rows,
        )
        return after, spoken(evidence > LARGEST, stacked(classical, learned))

    @abstractmethod
    def scores(
        self, before: BankBelief, after: BankBelief, observation: Observation
    ) -> tuple[Float[Tensor, "B N"], Float[Tensor, "B N"]]:
        """How well the candidate and the fallback predicted what is measured in this step."""

    @abstractmethod
    def restarted(
        self, belief: BankBelief, rows: Bool[Tensor, "B N"], observation: Observation
    ) -> Any:
        """The candidate's belief, restarted from the fallback's for the UAVs in ``rows``."""

    def mean(self, belief: BankBelief) -> Float64[Tensor, "B N S"]:
        ours = self.candidate.mean(belief.candidate).double()
        speaks = (belief.evidence > LARGEST).unsqueeze(-1)
        return torch.where(speaks, ours, self.fallback.mean(belief.fallback))

    def shifted(self, belief: BankBelief, offset: Float[Tensor, "B N d"]) -> BankBelief:
        return belief.replace(
            fallback=self.fallback.shifted(belief.fallback, offset),
            candidate=self.candidate.shifted(belief.candidate, offset),
        )

    def diagnostics(self, belief: BankBelief) -> dict[str, Tensor]:
        speaks = belief.evidence > LARGEST
        return self.candidate.diagnostics(belief.candidate) | {
            self.shares[0]: speaks.float(),
            self.shares[1]: (~speaks).float(),
            "restarts_per_run": belief.restarted.float(),
        }
