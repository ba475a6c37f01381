"""How much each link counts: all alike, Huber's way, or as calibrated on links of known length."""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.swarm.calibration import ErrorModel, judged

HUBER = 1.345  # standard deviations
_FLAGGED = 3.0  # standard deviations from which on the paper's detector says NLOS
_NLOS, _LOSS, _LEAST = 0.5, 0.3, 0.1  # the paper's coefficients; its c_min is not given


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


def papers(
    residual: Float64[Tensor, "B N N"],
    silent: Float64[Tensor, "B N N"],
    added: Float64[Tensor, "B N N"],
    std: float,
) -> Float64[Tensor, "B N N"]:
    """ST-DCL's confidence of each link, clip(1 − 0.5 s − 0.3 ρ, c_min, 1) (equation 17): s whether
    its residual is flagged as NLOS, ρ how often the link was ``silent``."""
    flagged = residual > _FLAGGED * (std**2 + added).sqrt()
    return (1 - _NLOS * flagged.to(torch.float32) - _LOSS * silent).clamp(_LEAST, 1.0)


def calibrated(
    residual: Float64[Tensor, "B N N"],
    mask: Bool[Tensor, "B N N"],
    added: Float64[Tensor, "B N N"],
    std: float,
    model: ErrorModel,
    prior: Float64[Tensor, "B N N"] | None,
) -> tuple[Float64[Tensor, "B N N"], Float64[Tensor, "B N N"]]:
    """Weights and shifts of a mixture that was fitted to links between anchors; ``prior``:
    probability that a link is an outlier (None: its share of all)."""
    weight, shift = judged(model, residual, added, std, prior)
    return weight * mask, shift


def loess(
    distance: Float64[Tensor, "B N N"], mask: Bool[Tensor, "B N N"], bandwidth: float
) -> Float64[Tensor, "B N N"]:
    """exp(−d²/h²) with h ``bandwidth`` times the longest range that either end has (Costa, Patwari
    & Hero 2006, after Cleveland's LOESS): near neighbours count more."""
    longest = (distance * mask).amax(-1)
    longest = torch.maximum(longest.unsqueeze(-1), longest.unsqueeze(-2)).clamp_min(1e-9)
    return torch.exp(-(distance / longest / bandwidth).square()) * mask
