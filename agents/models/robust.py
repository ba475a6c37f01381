"""Weights that keep outliers from an update: Huber's and a Mahalanobis gate."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

import torch
from jaxtyping import Float
from scipy.stats import chi2
from torch import Tensor

from agents.models.measurements import Block

Robust = Literal["none", "huber", "gate"]
Weights = Sequence[Float[Tensor, "B N m"]]
_CORE = 0.8214  # share of a Gaussian inside Huber's quadratic core for 95 % efficiency (1.345 σ)


def check_gate(gate: float) -> None:
    """Raise ValueError unless it is the probability of a quantile."""
    if not 0 < gate < 1:
        raise ValueError(f"gate={gate} is not allowed: a probability in (0, 1)")


@lru_cache
def chi_square(probability: float, dof: int) -> float:
    """Quantile of the χ² distribution."""
    return float(chi2.ppf(probability, dof))


def huber_weights(block: Block) -> Float[Tensor, "B N m"]:
    """min(1, c/‖r̃‖) of the residual scaled by its noise (Huber 1964); c grows with its size k so
    that the same share of inliers keeps full weight."""
    squared = (block.residual**2 / block.total_variance).sum(-1)
    core = chi_square(_CORE, block.residual.shape[-1])
    return (core / squared.clamp_min(core)).sqrt()


def gate_weights(
    block: Block, covariance: Float[Tensor, "B N E E"], probability: float
) -> Float[Tensor, "B N m"]:
    """1 where the innovation's Mahalanobis distance is inside the χ² ``probability`` quantile."""
    h, r = block.jacobian, block.residual
    s = h @ covariance.unsqueeze(-3) @ h.mT + torch.diag_embed(block.total_variance)
    distance = (r * torch.linalg.solve(s, r)).sum(-1)
    return (distance <= chi_square(probability, r.shape[-1])).to(r.dtype)


def weigh(
    robust: Robust,
    gate: float,
    blocks: Sequence[Block],
    covariance: Float[Tensor, "B N E E"],
    last: Weights | None,
) -> Weights:
    """Weights of one iteration: the gate is decided once, by the innovations under the prior
    ``covariance``; Huber's follow the iterate."""
    if robust == "huber":
        return [huber_weights(block) for block in blocks]
    if last is not None:
        return last
    if robust == "gate":
        return [gate_weights(block, covariance, gate) for block in blocks]
    return [torch.ones_like(block.residual[..., 0]) for block in blocks]
