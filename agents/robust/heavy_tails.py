"""Likelihoods with heavier tails than the Gaussian's, of residuals scaled by their noise.

s = rᵀ R⁻¹ r of a residual r of size k. The weight of each is w = −2 d log p / ds, with which
iterated least squares finds the most likely state (Lange, Little & Taylor, JASA 84, 1989); a
Gaussian's is 1.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.measurements import Block

DEGREES = 4.0  # ν of Student's t
OUTLIERS, SPREAD = 0.1, 10.0  # of the mixture: share of the wide part, its standard deviations

LogDensity = Callable[[Float[Tensor, "*s"], int], Float[Tensor, "*s"]]
"""log p by s and k, where R = I."""


def gaussian_log_density(squared: Float[Tensor, "*s"], size: int) -> Float[Tensor, "*s"]:
    """log N(0, I) = −(s + k log 2π)/2."""
    return -0.5 * (squared + size * math.log(2 * math.pi))


def student_log_density(squared: Float[Tensor, "*s"], size: int) -> Float[Tensor, "*s"]:
    """log p of Student's t with ν = 4 and shape I: −(ν + k)/2 · log(1 + s/ν) + const."""
    top = math.lgamma(0.5 * (DEGREES + size)) - math.lgamma(0.5 * DEGREES)
    at_zero = top - 0.5 * size * math.log(DEGREES * math.pi)
    return at_zero - 0.5 * (DEGREES + size) * (squared / DEGREES).log1p()


def student_weights(block: Block) -> Float[Tensor, "B N m"]:
    """(ν + k) / (ν + s): above 1 where the residual is small, so that it is 1 on average."""
    squared = _squared(block)
    return (DEGREES + block.residual.shape[-1]) / (DEGREES + squared)


def mixture_log_density(squared: Float[Tensor, "*s"], size: int) -> Float[Tensor, "*s"]:
    """log p of (1 − ε) N(0, I) + ε N(0, c² I), ε = 0.1, c = 10."""
    narrow = math.log1p(-OUTLIERS) + gaussian_log_density(squared, size)
    return torch.logaddexp(narrow, _wide(squared, size))


def mixture_weights(block: Block) -> Float[Tensor, "B N m"]:
    """γ + (1 − γ)/c², γ being the probability of the narrow part given the residual."""
    squared, size = _squared(block), block.residual.shape[-1]
    narrow = math.log1p(-OUTLIERS) + gaussian_log_density(squared, size)
    inlier = torch.sigmoid(narrow - _wide(squared, size))
    return inlier + (1 - inlier) / SPREAD**2


def _wide(squared: Float[Tensor, "*s"], size: int) -> Float[Tensor, "*s"]:
    wide = gaussian_log_density(squared / SPREAD**2, size)
    return math.log(OUTLIERS) - size * math.log(SPREAD) + wide


def _squared(block: Block) -> Float[Tensor, "B N m"]:
    return (block.residual**2 / block.total_variance).sum(-1)
