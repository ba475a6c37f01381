"""Weights W_ij of links: uniform, Huber's, ST-DCL's confidence, and LOESS.

Uniform weights, Huber's and confidences are of matrices [B, N, N] or lists [B, E] of links alike.
"""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

HUBER = 1.345  # standard deviations
TRUNCATED = 9.0  # c̄²: normalized squared residuals from which on a range is an outlier
GRADUATION, GRADUATIONS = 1.4, 25  # of μ, in each of so many iterations
_FLAGGED = 3.0  # standard deviations from which on a residual is flagged as NLOS
_NLOS, _LOSS, _C_MIN = 0.5, 0.3, 0.1  # coefficients of equation 17; the paper does not give c_min


def uniform(
    residual: Float64[Tensor, "B *L"], mask: Bool[Tensor, "B *L"], std: float
) -> tuple[Float64[Tensor, "B *L"], Float64[Tensor, "B *L"]]:
    """Weights 1/σ² and no shifts."""
    return mask.double() / std**2, torch.zeros_like(residual)


def huber(
    residual: Float64[Tensor, "B *L"],
    mask: Bool[Tensor, "B *L"],
    variance: Float64[Tensor, "B *L"],
    std: float,
) -> tuple[Float64[Tensor, "B *L"], Float64[Tensor, "B *L"]]:
    """Weights min(1, 1.345 s/|r|)/σ² and no shifts; s² = σ² + the ``variance`` (m²) of the vector
    between the ends."""
    scale = HUBER * (std**2 + variance).sqrt()
    weight = (scale / residual.abs().clamp_min(1e-12)).clamp_max(1.0)
    return weight * mask / std**2, torch.zeros_like(residual)


def first_mu(squared: Float64[Tensor, "B N N"]) -> Float64[Tensor, "B 1 1"]:
    """μ = c̄² / (2 r̂²_max − c̄²), of which the surrogate is convex at these normalized ``squared``
    residuals r̂² (GNC, remark 5); large, which is the truncated loss, where all are inliers."""
    most = squared.amax((-2, -1), keepdim=True)
    return TRUNCATED / (2 * most - TRUNCATED).clamp_min(1e-3)


def truncated(
    squared: Float64[Tensor, "B N N"], mu: Float64[Tensor, "B 1 1"]
) -> Float64[Tensor, "B N N"]:
    """Weights of the truncated least squares' surrogate: 1 up to r̂² = μ/(μ+1) c̄², 0 from
    (μ+1)/μ c̄² on, √(c̄² μ (μ+1) / r̂²) − μ between (GNC, equation 14)."""
    between = (TRUNCATED * mu * (mu + 1) / squared.clamp_min(1e-12)).sqrt() - mu
    return between.clamp(0.0, 1.0)


def paper_confidence(
    residual: Float64[Tensor, "B *L"],
    packet_loss: Float64[Tensor, "B *L"],
    variance: Float64[Tensor, "B *L"],
    std: float,
) -> Float64[Tensor, "B *L"]:
    """c_ij = clip(1 − 0.5 s_ij − 0.3 ρ_ij, c_min, 1) (ST-DCL, equation 17): s_ij = 1 where the
    residual is flagged as NLOS, ρ_ij the rate of ``packet_loss``."""
    s = residual > _FLAGGED * (std**2 + variance).sqrt()
    return (1 - _NLOS * s.to(torch.float32) - _LOSS * packet_loss).clamp(_C_MIN, 1.0)


def loess(
    distance: Float64[Tensor, "B N N"], mask: Bool[Tensor, "B N N"], bandwidth: float
) -> Float64[Tensor, "B N N"]:
    """exp(−d²/h²) with h ``bandwidth`` times the longest range that either end has (Costa, Patwari
    & Hero 2006, after Cleveland's LOESS): near neighbours count more."""
    longest = (distance * mask).amax(-1)
    longest = torch.maximum(longest.unsqueeze(-1), longest.unsqueeze(-2)).clamp_min(1e-9)
    return torch.exp(-(distance / longest / bandwidth).square()) * mask
