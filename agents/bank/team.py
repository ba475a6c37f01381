"""A bank for filters that estimate a whole team at once: a learned loop falls back to ``map``."""

from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.bank.bank import BankBelief, candidate_speaks, spoken
from agents.bank.branches import stacked
from agents.bank.evidence import BankOptions, accumulated, predictive_score
from agents.localizer import Estimate, Localizer
from agents.models.measurements import Block
from agents.swarm.belief import StepInput
from agents.swarm.links import lengths
from agents.tensorclasses import build
from coloc_env.observation import Observation


class TeamBank(Localizer[BankBelief]):
    """Two methods side by side. Each UAV speaks with the learned one while the evidence A ≥ 0 that
    this predicts its ranges better; at A < θ it is moved to where the other has it, with A = 0."""

    name = "team_bank"
    centralized = True

    def __init__(self, candidate: Any, fallback: Any, options: BankOptions) -> None:
        """``candidate``: a learned filter of swarms; ``fallback``: a swarm filter."""
        super().__init__(candidate.believed)
        self.name = candidate.name  # type: ignore[misc]
        self.candidate, self.fallback, self.options = candidate, fallback, options

    @property
    def exchanges(self) -> bool:
        return True

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
        degrees = self.options.degrees
        ours, theirs = (
            range_score(branch.predict(state, observation), branch.std, degrees)
            for branch, state in (
                (self.candidate, belief.candidate),
                (self.fallback, belief.fallback),
            )
        )
        evidence = accumulated(belief.evidence, ours, theirs, self.options.forgetting)
        fallback, classical = self.fallback.step(belief.fallback, observation)
        candidate, learned = self.candidate.step(belief.candidate, observation)
        restarted = evidence < self.options.restart
        apart = (classical.position - learned.position) * restarted.unsqueeze(-1)
        after = build(
            BankBelief,
            belief.batch_size,
            fallback=fallback,
            candidate=self.candidate.shifted(candidate, apart),
            evidence=evidence.masked_fill(restarted, 0.0),
            restarted=restarted,
        )
        return after, spoken(evidence >= 0, stacked(classical, learned))

    def mean(self, belief: BankBelief) -> Float64[Tensor, "B N S"]:
        ours = self.candidate.mean(belief.candidate)
        speaks = candidate_speaks(belief)
        return torch.where(speaks.unsqueeze(-1), ours, self.fallback.mean(belief.fallback))

    def shifted(self, belief: BankBelief, offset: Float64[Tensor, "B N d"]) -> BankBelief:
        return belief.replace(
            fallback=self.fallback.shifted(belief.fallback, offset),
            candidate=self.candidate.shifted(belief.candidate, offset),
        )

    def diagnostics(self, belief: BankBelief) -> dict[str, Tensor]:
        speaks = candidate_speaks(belief)
        return self.candidate.diagnostics(belief.candidate) | {
            "learned_share": speaks.float(),
            "map_share": (~speaks).float(),
            "restarts_per_run": belief.restarted.float(),
        }


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
