"""Gaussian measurement updates in information form, as every EKF here uses them."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.measurements import Block, Neighbours
from agents.models.ordered_update import Estimation, ordered_update
from agents.robust.screen import Prediction, Screen, Trust


@dataclass(frozen=True)
class Update:
    """A posterior, the trust that its measurements got, and what the screen remembers."""

    state: Float[Tensor, "B N S"]
    covariance: Float[Tensor, "B N E E"]
    trusts: list[Trust]
    memory: Float[Tensor, "B N K"]


def information(
    blocks: Sequence[Block], trusts: Sequence[Trust]
) -> tuple[Float[Tensor, "B N E E"], Float[Tensor, "B N E"]]:
    """Λ = Σ w Hᵀ R⁻¹ H and η = Σ w Hᵀ R⁻¹ r over all measurements of all blocks."""
    rows, scaled, residuals = [], [], []
    for block, trust in zip(blocks, trusts, strict=True):
        h = block.jacobian.flatten(-3, -2)
        rows.append(h)
        scaled.append(h * trust.information(block).flatten(-2).unsqueeze(-1))
        residuals.append(trust.residual(block).flatten(-2))
    h, wh = torch.cat(rows, -2), torch.cat(scaled, -2)
    r = torch.cat(residuals, -1)
    return h.mT @ wh, (wh.mT @ r.unsqueeze(-1))[..., 0]


def posterior(
    covariance: Float[Tensor, "*s E E"],
    precision: Float[Tensor, "*s E E"],
    vector: Float[Tensor, "*s E"],
) -> tuple[Float[Tensor, "*s E"], Float[Tensor, "*s E E"]]:
    """δ = P⁺ η and P⁺ = (P⁻¹ + Λ)⁻¹ = (I + P Λ)⁻¹ P, which needs no inverse of P."""
    eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    updated = torch.linalg.solve(eye + covariance @ precision, covariance)
    updated = 0.5 * (updated + updated.mT)
    return (updated @ vector.unsqueeze(-1))[..., 0], updated


def iterated_update(
    prior: Prediction, neighbours: Neighbours, screen: Screen, iterations: int
) -> Update:
    """Iterated (Gauss-Newton) EKF update of a prior, its measurements weighted by a screen.

    Where the prior is broad, the screen's extra iterations come first, and what is trusted in the
    end is then used again from the prior on, in order: see ``ordered_update``.
    """
    process, x, covariance = screen.process, prior.state, prior.covariance
    state, updated, delta = x, covariance, torch.zeros_like(covariance[..., 0])
    evidence, trusts = None, []
    broad = prior.broad(process.dim).unsqueeze(-1)
    any_broad = bool(broad.any())
    extra = screen.extra if any_broad else 0

    def linearize(at: Tensor) -> list[Block]:
        return [m.linearize(process, at, prior.observation, neighbours) for m in screen.models]

    for iteration in range(-extra, iterations):
        blocks = linearize(state)
        if iteration == -extra:
            evidence = screen.judge(blocks, prior)
        trusts = screen.weigh(blocks, evidence, iteration == iterations - 1)
        precision, vector = information(blocks, trusts)
        if iteration > -extra:  # residuals are about state = x ⊞ δ: refer them to the prior
            vector = vector + (precision @ delta.unsqueeze(-1))[..., 0]
        delta, updated = posterior(covariance, precision, vector)
        state = process.boxplus(x, delta)
        if iteration < 0:  # extra iterations are for broad priors alone
            delta, state = torch.where(broad, delta, 0.0), torch.where(broad, state, x)
    if any_broad:
        slots, d = neighbours.known.shape[-1], process.dim
        everyone = torch.arange(x.shape[1], device=x.device)

        def apart(p: Tensor, slot: Tensor) -> Tensor:
            return p[..., :d, :d] + torch.diag_embed(neighbours.variance[:, everyone, slot])

        rounds = torch.arange(slots, device=x.device).unsqueeze(-1).expand(-1, x.shape[1])
        model = Estimation(linearize, information, process.boxplus, apart, process.dt)
        by_order, narrowed = ordered_update(x, covariance, model, trusts, rounds, slots)
        state = torch.where(broad, by_order, state)
        updated = torch.where(broad.unsqueeze(-1), narrowed, updated)
    memory = screen.remember(prior, evidence, lambda: linearize(state))
    return Update(state, updated, trusts, memory)
