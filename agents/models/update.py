"""Gaussian measurement updates in information form: what every EKF here is made of."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.measurements import Block
from agents.models.process import Process
from agents.models.robust import Weights

Weigh = Callable[[Sequence[Block], Weights | None], Weights]
Linearize = Callable[[Float[Tensor, "B N S"]], Sequence[Block]]


def information(
    blocks: Sequence[Block], weights: Weights
) -> tuple[Float[Tensor, "B N E E"], Float[Tensor, "B N E"]]:
    """Λ = Σ w Hᵀ R⁻¹ H and η = Σ w Hᵀ R⁻¹ r over all measurements of all blocks."""
    rows, scaled, residuals = [], [], []
    for block, weight in zip(blocks, weights, strict=True):
        w = (weight * block.mask).unsqueeze(-1) / block.total_variance
        h = block.jacobian.flatten(-3, -2)
        rows.append(h)
        scaled.append(h * w.flatten(-2).unsqueeze(-1))
        residuals.append(block.residual.flatten(-2))
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
    process: Process,
    x: Float[Tensor, "B N S"],
    covariance: Float[Tensor, "B N E E"],
    linearize: Linearize,
    weigh: Weigh,
    iterations: int,
) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"]]:
    """Iterated (Gauss-Newton) EKF update of a prior (x, P).

    ``weigh`` gives each iteration's weights from its blocks and the last iteration's weights.
    """
    state, updated, weights, delta = x, covariance, None, covariance[..., 0]
    for iteration in range(iterations):
        blocks = linearize(state)
        weights = weigh(blocks, weights)
        precision, vector = information(blocks, weights)
        if iteration:  # residuals are about state = x ⊞ δ: refer them to the prior
            vector = vector + (precision @ delta.unsqueeze(-1))[..., 0]
        delta, updated = posterior(covariance, precision, vector)
        state = process.boxplus(x, delta)
    return state, updated
