"""Weighted particles: their moments on the manifold, systematic resampling, regularization."""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float, Float32, Float64, Int64
from torch import Tensor


def effective_sample_size(log_weights: Float[Tensor, "*s M"]) -> Float[Tensor, "*s"]:
    """1 / Σ w² of the normalized weights."""
    weights = (log_weights.double() - log_weights.amax(-1, keepdim=True)).exp_()
    return (weights.sum(-1) ** 2 / weights.square().sum(-1)).to(log_weights.dtype)


def normalized(log_weights: Float32[Tensor, "*s M"]) -> Float32[Tensor, "*s M"]:
    """Log-weights whose weights sum to 1."""
    return log_weights.double().log_softmax(-1).to(log_weights.dtype)


def select(x: Float[Tensor, "B N M k"], index: Int64[Tensor, "B N m"]) -> Float[Tensor, "B N m k"]:
    """Particles by index, in the memory order of ``geometry.join``."""
    first = x.movedim(-1, 0)
    return first.gather(-1, index.expand(len(first), *index.shape)).movedim(0, -1)


class Manifold(Protocol):
    """Where particles live: x ⊞ δ, errors x ⊟ y of ``error_size``; ``noise_size`` numbers are a
    step's noise."""

    error_size: int
    noise_size: int

    def boxplus(
        self, x: Float[Tensor, "*s S"], delta: Float[Tensor, "*s E"]
    ) -> Float[Tensor, "*s S"]: ...

    def boxminus(
        self, x: Float[Tensor, "*s S"], y: Float[Tensor, "*s S"]
    ) -> Float[Tensor, "*s E"]: ...


@dataclass(frozen=True)
class Moments:
    """A weighted cloud's mean and error covariance, and what they were made from: every particle's
    error ``apart`` from a heavy one, and ``shift``, the mean's."""

    mean: Float32[Tensor, "B N S"]
    covariance: Float64[Tensor, "B N E E"]
    apart: Float32[Tensor, "B N M E"]
    shift: Float32[Tensor, "B N E"]


def moments(
    space: Manifold, particles: Float32[Tensor, "B N M S"], weights: Float32[Tensor, "B N M"]
) -> Moments:
    """Weighted mean and covariance; a heavy particle anchors the mean of attitudes, whose tangents
    are averaged about it.

    Sums over particles are float64 here and below: how many dead particles (of weight 0) a batch
    drags along must not show.
    """
    anchor = select(particles, weights.argmax(-1, keepdim=True))
    apart = space.boxminus(particles, anchor)
    exact = apart.double()
    scaled = exact * weights.unsqueeze(-1)
    first = scaled.sum(-2)
    covariance = exact.mT @ scaled - first.unsqueeze(-1) * first.unsqueeze(-2)
    shift = first.to(apart.dtype)
    return Moments(space.boxplus(anchor[..., 0, :], shift), covariance, apart, shift)


def systematic(
    weights: Float32[Tensor, "B N M"],
    offset: Float32[Tensor, "B N"],
    count: Int64[Tensor, "B N"] | None = None,
) -> Int64[Tensor, "B N M"]:
    """Systematic resampling (Kitagawa 1996): ancestors of ``count`` equally weighted particles (M
    where None); later slots are arbitrary.

    Rung i is at (i + offset) / count; its ancestor's number is that of the particles whose
    cumulative weight lies below, so counting where those fall replaces M searches.
    """
    m = weights.shape[-1]
    rungs = torch.full_like(offset, m) if count is None else count
    cumulative = weights.double().cumsum(-1)
    height = cumulative * (rungs.unsqueeze(-1) / cumulative[..., -1:])
    height = height - offset.double().unsqueeze(-1)
    # The first rung above each particle; a UAV whose weights are NaN gets some ancestors, too.
    first = (height.floor() + 1).nan_to_num_().clamp_(0, m).to(torch.int64)
    passed = torch.zeros(*weights.shape[:-1], m + 1, dtype=torch.int64, device=weights.device)
    passed.scatter_add_(-1, first, torch.ones_like(first))
    return passed[..., :m].cumsum(-1).clamp_max_(m - 1)


def liu_west(
    space: Manifold,
    cloud: Moments,
    ancestors: Int64[Tensor, "B N M"],
    noise: Float32[Tensor, "B N M E"],
    shrink: float,
    floor: Float64[Tensor, "E"],
) -> Float32[Tensor, "B N M S"]:
    """Regularization x ← μ ⊞ (√(1−h²) (x ⊟ μ) + N(0, h² Σ + floor)) (Liu & West 2001) of each
    particle's ancestor, which keeps the cloud's mean and, floor aside, its covariance. ``shrink``
    is h."""
    spread = shrink**2 * cloud.covariance + torch.diag(floor**2)
    factor = torch.linalg.cholesky_ex(spread).L.to(noise.dtype)
    apart = select(cloud.apart, ancestors) - cloud.shift.unsqueeze(-2)
    moved = math.sqrt(1 - shrink**2) * apart + (factor @ noise.mT).mT
    return space.boxplus(cloud.mean.unsqueeze(-2), moved)
