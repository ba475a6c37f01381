"""Covariance intersection with all neighbours at once, ranges expanded to the second order.

One iteration, on messages alone: ``ekf:fusion=ci:second_order=true``, which the tasks use, whose
priors are broad. Split covariance intersection (Julier & Uhlmann 2001; Li & Nashashibi 2013): own
covariance over ω, the neighbours' over 1 − ω, ω chosen for the least position variance.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.measurements import Block, Measurement, Neighbours
from agents.models.measurements.second_order import expanded
from agents.models.ordered_update import by_kind, pick
from agents.models.update import Update, information, posterior
from agents.robust import Prediction, Screen, Trust

_OMEGA = (1.0, 0.99, 0.97, 0.93, 0.87, 0.8, 0.7, 0.55, 0.4)  # weights tried


def expanded_update(prior: Prediction, neighbours: Neighbours, screen: Screen) -> Update:
    """First the UAV's own measurements, then an intersection with what involves neighbours."""
    process, models = screen.process, screen.models
    x, covariance = prior.state, prior.covariance
    blocks = _blocks(x, covariance, prior, neighbours, screen, models)
    evidence = screen.judge(blocks, prior)
    trusts = screen.weigh(blocks, evidence, True)
    own, shared = by_kind(models)
    if own:
        known = information(pick(blocks, own), pick(trusts, own))
        delta, covariance = posterior(covariance, *known)
        x = process.boxplus(x, delta)
    if shared:
        theirs = _blocks(x, covariance, prior, neighbours, screen, pick(models, shared))
        delta, covariance = _intersect(covariance, theirs, pick(trusts, shared), process.dim)
        x = process.boxplus(x, delta)
    memory = screen.remember(
        prior, evidence, lambda: _blocks(x, covariance, prior, neighbours, screen, models)
    )
    return Update(x, covariance, blocks, trusts, memory)


def _blocks(
    x: Float[Tensor, "B N S"],
    covariance: Float[Tensor, "B N E E"],
    prior: Prediction,
    neighbours: Neighbours,
    screen: Screen,
    models: Sequence[Measurement],
) -> list[Block]:
    """Measurements linearized at a state, ranges expanded to the second order."""
    process, observation = screen.process, prior.observation
    own = covariance[..., None, : process.dim, : process.dim]
    apart = own + torch.diag_embed(neighbours.variance)
    return [
        expanded(
            model,
            model.linearize(process, x, observation, neighbours),
            apart if model.cooperative else own,
            observation,
        )
        for model in models
    ]


def _intersect(
    covariance: Float[Tensor, "B N E E"],
    blocks: Sequence[Block],
    trusts: Sequence[Trust],
    d: int,
) -> tuple[Float[Tensor, "B N E"], Float[Tensor, "B N E E"]]:
    """The correction and the covariance after it, for the best ω."""
    best: tuple[Tensor, Tensor, Tensor] | None = None
    for omega in _OMEGA:
        if omega == 1.0:
            delta, updated = torch.zeros_like(covariance[..., 0]), covariance
        else:
            apart = [_inflated(block, 1 - omega) for block in blocks]
            delta, updated = posterior(covariance / omega, *information(apart, trusts))
        trace = updated[..., :d, :d].diagonal(dim1=-2, dim2=-1).sum(-1)
        if best is None:
            best = (trace, delta, updated)
        else:
            better = trace < best[0]
            best = (
                torch.where(better, trace, best[0]),
                torch.where(better[..., None], delta, best[1]),
                torch.where(better[..., None, None], updated, best[2]),
            )
    assert best is not None
    return best[1], best[2]


def _inflated(block: Block, share: float) -> Block:
    """The block with its partners' uncertainty divided by their share of the weight."""
    assert block.partner_variance is not None
    return replace(block, partner_variance=block.partner_variance / share)
