"""A bank for particle filters, which falls back to a Kalman filter with Huber's weights.

Few particles hold little of what a state's components have in common, and where measurements are
rare (MILUV: an anchor range a second for an error of 15 components) no screen mends that: a cloud
that is lost is restarted from the Kalman filter's Gaussian.
"""

from typing import Any

from jaxtyping import Bool, Float
from torch import Tensor

from agents.bank.bank import Bank, BankBelief
from agents.bank.evidence import BankOptions
from agents.bank.scored import Scored
from agents.bank.side_by_side import SideBySide
from agents.bank.trial import Trial
from agents.kalman.ekf import CooperativeEkf
from coloc_env.observation import Observation


class KalmanFallback(SideBySide):
    """A particle filter, alone or with restarts on trial, beside ``ekf:robust=huber``."""

    name = "kalman_fallback"

    def __init__(self, candidate: Any, options: BankOptions, share: str) -> None:
        """``candidate``: a particle filter, whose screen is replaced by one that keeps scores, or a
        ``Trial`` of one. ``share``: what the share of time in which it speaks is called."""
        cooperate = any(model.cooperative for model in candidate.models)
        fallback = CooperativeEkf(candidate.believed, robust="huber", cooperate=cooperate)
        super().__init__(candidate, fallback, options)
        self.process, self.models = candidate.process, candidate.models
        self.shares = share, "huber_share"  # type: ignore[misc]
        fallback.screen = Scored(fallback.screen, options.degrees)
        if not isinstance(candidate, Trial):
            candidate.screen = Scored(candidate.screen, options.degrees)

    def scores(
        self, before: BankBelief, after: BankBelief, observation: Observation
    ) -> tuple[Float[Tensor, "B N"], Float[Tensor, "B N"]]:
        ours = after.candidate
        if isinstance(self.candidate, Trial):  # the filter itself, not the restart on trial
            ours = ours.fallback
        return ours.memory[..., -1], after.fallback.memory[..., -1]

    def restarted(
        self, belief: BankBelief, rows: Bool[Tensor, "B N"], observation: Observation
    ) -> Any:
        state, covariance = self.fallback.gaussian(belief.fallback, observation)
        if isinstance(self.candidate, Trial):  # both branches, at once
            return Bank.restart_from(self.candidate, belief.candidate, rows, state, covariance)
        return self.candidate.restart_from(belief.candidate, rows, state, covariance)

    def restart_from(
        self,
        belief: BankBelief,
        rows: Bool[Tensor, "B N"],
        state: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N E E"],
    ) -> BankBelief:
        """The belief with the candidate restarted, or a restart of it on trial."""
        return belief.replace(
            candidate=self.candidate.restart_from(belief.candidate, rows, state, covariance)
        )
