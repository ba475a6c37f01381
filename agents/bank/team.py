"""A bank for filters that estimate a whole team at once: what is learned falls back to ``map``."""

from typing import Any

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.bank.bank import BankBelief
from agents.bank.evidence import predictive_score
from agents.bank.side_by_side import SideBySide
from agents.models.measurements import Block
from agents.swarm.belief import StepInput
from agents.swarm.links import lengths
from coloc_env.observation import Observation


class TeamBank(SideBySide):
    """A learned filter of swarms beside a swarm filter: evidence is of ranges between UAVs. What
    restarts is moved to where the other has it."""

    name = "team_bank"
    centralized = True
    shares = "learned_share", "map_share"

    @property
    def exchanges(self) -> bool:
        return True

    def scores(
        self, before: BankBelief, after: BankBelief, observation: Observation
    ) -> tuple[Float64[Tensor, "B N"], Float64[Tensor, "B N"]]:
        pairs = (self.candidate, before.candidate), (self.fallback, before.fallback)
        ours, theirs = (
            range_score(one.predict(belief, observation), one.std, self.options.degrees)
            for one, belief in pairs
        )
        return ours, theirs

    def restarted(
        self, belief: BankBelief, rows: Bool[Tensor, "B N"], observation: Observation
    ) -> Any:
        d = self.fallback.process.dim
        there, here = self.fallback.mean(belief.fallback), self.candidate.mean(belief.candidate)
        apart = (there - here)[..., :d] * rows.unsqueeze(-1)
        return self.candidate.shifted(belief.candidate, apart)


def range_score(inputs: StepInput, std: float, degrees: float) -> Float64[Tensor, "B N"]:
    """The predictive score of each UAV's ranges: r_ij = d̃_ij − ‖m_i − m_j‖ with the variance of
    the vector between the priors (per axis) and of the noise."""
    links = inputs.links
    residual = (links.distance - lengths(inputs.prior)).unsqueeze(-1)
    variance = (inputs.pair_variance + std**2).unsqueeze(-1)
    nothing = residual.new_zeros(*residual.shape, 0)  # S is all in the variance
    block = Block(
        residual=torch.where(links.mask.unsqueeze(-1), residual, 0.0),
        jacobian=nothing,
        variance=variance,
        mask=links.mask,
        mutual=True,
    )
    return predictive_score([block], residual.new_zeros(*residual.shape[:2], 0, 0), degrees)
