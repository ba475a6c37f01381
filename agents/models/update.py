"""Gaussian measurement updates in information form, as every EKF here uses them."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.measurements import Block, Measurement, Neighbours
from agents.models.measurements.second_order import expanded
from agents.models.ordered_update import Estimation, by_kind, ordered_update, pick
from agents.robust.screen import Prediction, Screen, Trust


@dataclass(frozen=True)
class Update:
    """A posterior, the blocks of its last iteration with the trust that these got, and what the
    screen remembers."""

    state: Float[Tensor, "B N S"]
    covariance: Float[Tensor, "B N E E"]
    blocks: list[Block]
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

    Where the prior is broad, the screen's extra iterations come first; where it is vague, what is
    trusted in the end is used again from the prior on, in order: see ``ordered_update``.
    """
    process, x, covariance = screen.process, prior.state, prior.covariance
    state, updated, delta = x, covariance, torch.zeros_like(covariance[..., 0])
    evidence, blocks, trusts = None, [], []
    first: list[Block] = []  # at the prior
    broad = prior.broad(process.dim).unsqueeze(-1)
    extra = screen.extra if bool(broad.any()) else 0

    known = covariance[..., : process.dim, : process.dim]

    def linearize(at: Tensor, models: Sequence[Measurement]) -> list[Block]:
        blocks = [m.linearize(process, at, prior.observation, neighbours) for m in models]
        return [block.curved(known) for block in blocks]

    for iteration in range(-extra, iterations):
        blocks = linearize(state, screen.models)
        if iteration == -extra:
            first, evidence = blocks, screen.judge(blocks, prior)
        trusts = screen.weigh(blocks, evidence, iteration == iterations - 1)
        precision, vector = information(blocks, trusts)
        if iteration > -extra:  # residuals are about state = x ⊞ δ: refer them to the prior
            vector = vector + (precision @ delta.unsqueeze(-1))[..., 0]
        delta, updated = posterior(covariance, precision, vector)
        state = process.boxplus(x, delta)
        if iteration < 0:  # extra iterations are for broad priors alone
            delta, state = torch.where(broad, delta, 0.0), torch.where(broad, state, x)
    vague = prior.broad(process.dim, process.vague).unsqueeze(-1)
    if bool(vague.any()):
        d, theirs = process.dim, torch.diag_embed(neighbours.variance)
        own, shared = by_kind(screen.models)
        kinds = own, shared

        def at_vague(at: Tensor, cooperative: bool) -> list[Block]:
            which = kinds[cooperative]
            return pick(first, which) if at is x else linearize(at, pick(screen.models, which))

        model = Estimation(
            at_vague,
            information,
            process.boxplus,
            lambda p: p[..., None, :d, :d] + theirs,
            process.dt,
        )
        found = ordered_update(x, covariance, model, pick(trusts, own), pick(trusts, shared))
        state = torch.where(vague, found[0], state)
        updated = torch.where(vague.unsqueeze(-1), found[1], updated)
    memory = screen.remember(prior, evidence, lambda: linearize(state, screen.models))
    return Update(state, updated, blocks, trusts, memory)


def expanded_update(prior: Prediction, neighbours: Neighbours, screen: Screen) -> Update:
    """One update of a prior by measurements of the UAV alone, distances expanded to the second
    order: where the prior is broad, what lies across the line of sight counts as noise."""
    process, d = screen.process, screen.process.dim
    own = prior.covariance[..., None, :d, :d]

    def linearize(at: Tensor) -> list[Block]:
        seen = prior.observation
        linear = [
            m.linearize(process, at, seen, neighbours).curved(own[..., 0, :, :])
            for m in screen.models
        ]
        return [
            expanded(m, block, own, seen) for m, block in zip(screen.models, linear, strict=True)
        ]

    blocks = linearize(prior.state)
    evidence = screen.judge(blocks, prior)
    trusts = screen.weigh(blocks, evidence, True)
    delta, covariance = posterior(prior.covariance, *information(blocks, trusts))
    state = process.boxplus(prior.state, delta)
    memory = screen.remember(prior, evidence, lambda: linearize(state))
    return Update(state, covariance, blocks, trusts, memory)
