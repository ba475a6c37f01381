"""Weighted particles: their moments on the manifold, systematic resampling, regularization."""

import math

import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from agents.models.process import Process


def effective_sample_size(log_weights: Float[Tensor, "*s M"]) -> Float[Tensor, "*s"]:
    """1 / Σ w² of the normalized weights."""
    return torch.exp(-torch.logsumexp(2 * log_weights.log_softmax(-1), -1))


def select(x: Float[Tensor, "B N M k"], index: Int64[Tensor, "B N m"]) -> Float[Tensor, "B N m k"]:
    """Particles by index, in the memory order of ``geometry.join``."""
    first = x.movedim(-1, 0)
    return first.gather(-1, index.expand(len(first), *index.shape)).movedim(0, -1)


def moments(
    process: Process, particles: Float32[Tensor, "B N M S"], weights: Float32[Tensor, "B N M"]
) -> tuple[Float32[Tensor, "B N S"], Float32[Tensor, "B N M E"]]:
    """Weighted mean, and every particle's error from it; a heavy particle anchors the mean of
    attitudes, whose tangents are averaged about it."""
    anchor = select(particles, weights.argmax(-1, keepdim=True))
    apart = process.boxminus(particles, anchor)
    shift = (weights.unsqueeze(-2) @ apart)[..., 0, :]
    mean = process.boxplus(anchor[..., 0, :], shift)
    return mean, apart - shift.unsqueeze(-2)


def weighted_covariance(
    apart: Float32[Tensor, "B N M E"], weights: Float32[Tensor, "B N M"]
) -> Float32[Tensor, "B N E E"]:
    """Σ w δ δᵀ of errors about the mean."""
    return apart.mT @ (apart * weights.unsqueeze(-1))


def systematic(
    weights: Float32[Tensor, "B N M"], offset: Float32[Tensor, "B N"]
) -> Int64[Tensor, "B N M"]:
    """Systematic resampling (Kitagawa 1996): ancestors of M equally weighted particles.

    Rung i stands at (i + offset) / M; its ancestor's number is that of the particles whose
    cumulative weight lies below, so counting where those fall replaces M searches.
    """
    m = weights.shape[-1]
    cumulative = weights.double().cumsum(-1)
    height = cumulative * (m / cumulative[..., -1:]) - offset.double().unsqueeze(-1)
    # The first rung above each particle; a UAV whose weights are NaN gets some ancestors, too.
    first = (height.floor() + 1).nan_to_num_().clamp_(0, m).to(torch.int64)
    passed = torch.zeros(*weights.shape[:-1], m + 1, dtype=torch.int64, device=weights.device)
    passed.scatter_add_(-1, first, torch.ones_like(first))
    return passed[..., :m].cumsum(-1).clamp_max_(m - 1)


def liu_west(
    process: Process,
    mean: Float32[Tensor, "B N S"],
    apart: Float32[Tensor, "B N M E"],
    covariance: Float32[Tensor, "B N E E"],
    noise: Float32[Tensor, "B N M E"],
    shrink: float,
    floor: Float32[Tensor, "E"],
) -> Float32[Tensor, "B N M S"]:
    """Regularization x ← μ ⊞ (√(1−h²) (x ⊟ μ) + N(0, h² Σ + floor)) (Liu & West 2001), which
    keeps the cloud's mean and, floor aside, its covariance. ``shrink`` is h."""
    factor = torch.linalg.cholesky_ex(
        (shrink**2 * covariance + torch.diag(floor**2)).double()
    ).L.to(noise.dtype)
    moved = math.sqrt(1 - shrink**2) * apart + (factor @ noise.mT).mT
    return process.boxplus(mean.unsqueeze(-2), moved)
