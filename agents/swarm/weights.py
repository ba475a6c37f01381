"""How much each link counts: all alike, Huber's way, or as calibrated on links of known length."""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.swarm.calibration import ErrorModel, judged

HUBER = 1.345  # standard deviations


def plain(
    residual: Float64[Tensor, "B N N"], mask: Bool[Tensor, "B N N"], std: float
) -> tuple[Float64[Tensor, "B N N"], Float64[Tensor, "B N N"]]:
    """1/σ² for every link, and no shift."""
    return mask.double() / std**2, torch.zeros_like(residual)


def huber(
    residual: Float64[Tensor, "B N N"],
    mask: Bool[Tensor, "B N N"],
    added: Float64[Tensor, "B N N"],
    std: float,
) -> tuple[Float64[Tensor, "B N N"], Float64[Tensor, "B N N"]]:
    """min(1, 1.345 s/|r|)/σ² with s² = σ² plus what the ends' own uncertainty ``added`` (m²)."""
    scale = HUBER * (std**2 + added).sqrt()
    weight = (scale / residual.abs().clamp_min(1e-12)).clamp_max(1.0)
    return weight * mask / std**2, torch.zeros_like(residual)


def calibrated(
    residual: Float64[Tensor, "B N N"],
    mask: Bool[Tensor, "B N N"],
    added: Float64[Tensor, "B N N"],
    std: float,
    model: ErrorModel,
) -> tuple[Float64[Tensor, "B N N"], Float64[Tensor, "B N N"]]:
    """Weights and shifts of a mixture that was fitted to links between anchors."""
    weight, shift = judged(model, residual, added, std)
    return weight * mask, shift


def loess(
    distance: Float64[Tensor, "B N N"], mask: Bool[Tensor, "B N N"], bandwidth: float
) -> Float64[Tensor, "B N N"]:
    """exp(−d²/h²) with h ``bandwidth`` times the longest range that either end has (Costa, Patwari
    & Hero 2006, after Cleveland's LOESS): near neighbours count more."""
    longest = (distance * mask).amax(-1)
    longest = torch.maximum(longest.unsqueeze(-1), longest.unsqueeze(-2)).clamp_min(1e-9)
    return torch.exp(-(distance / longest / bandwidth).square()) * mask
