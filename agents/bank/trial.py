"""A bank whose candidate is a restart on trial."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.bank.bank import Bank, BankBelief, spoken
from agents.bank.branches import copied
from agents.localizer import Estimate
from agents.tensorclasses import build
from coloc_env.observation import Observation

_OPEN = 1.0  # nats: evidence below which another restart may take the place of the one on trial


class Trial(Bank):
    """A filter that is restarted only by what has predicted better than itself.

    What it is restarted from becomes the candidate, with A = 0. At A > −θ this takes the filter's
    place, and speaks; at A < θ the trial is over. Both branches have Huber's weights at most.
    """

    def step(self, belief: BankBelief, observation: Observation) -> tuple[BankBelief, Estimate]:
        fallback, candidate, evidence, estimates = self.branches(belief, observation)
        worse, better = evidence < self.options.restart, evidence > -self.options.restart
        fallback = copied(better, candidate, fallback)
        after = build(
            BankBelief,
            belief.batch_size,
            fallback=fallback,
            candidate=copied(worse, fallback, candidate),
            evidence=evidence.masked_fill(better | worse, 0.0),
            restarted=better,
        )
        return after, spoken(better, estimates)

    def speaks(self, belief: BankBelief) -> Bool[Tensor, "B N"]:
        """Nowhere: a candidate that is better has become the filter itself."""
        return torch.zeros_like(belief.restarted)

    def restart_from(
        self,
        belief: BankBelief,
        rows: Bool[Tensor, "B N"],
        state: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N E E"],
    ) -> BankBelief:
        """The belief with a restart on trial, but for the UAVs whose candidate is predicting better
        already."""
        rows = rows & (belief.evidence < _OPEN)
        return belief.replace(
            candidate=self.filter.restart_from(belief.candidate, rows, state, covariance),
            evidence=belief.evidence.masked_fill(rows, 0.0),
        )

    def diagnostics(self, belief: BankBelief) -> dict[str, Any]:
        return self.filter.diagnostics(belief.fallback) | {
            "resets_per_run": belief.restarted.float()
        }
