"""Likelihood of landmark sightings with mistaken identities, and its Gauss–Newton terms."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.models.measurements import Block


@dataclass(frozen=True)
class LandmarkFit:
    """``information`` Σ (ω/s²) JᵀJ and ``gradient`` Σ (ω/s²) Jᵀr by the error of the pose,
    ``log_density`` up to a constant, ``inliers``: each landmark's responsibility ω."""

    information: Float64[Tensor, "*s D D"]
    gradient: Float64[Tensor, "*s D"]
    log_density: Float64[Tensor, "*s"]
    inliers: Float64[Tensor, "*s L"]


def fit_landmarks(
    block: Block,
    variance: Float64[Tensor, "*s L"],
    share: float,
    volume: float,
) -> LandmarkFit:
    """A mixture of Gaussian sightings, of ``variance`` s² an axis, and mistaken ones, a ``share``
    ε of all, uniform over the ``volume`` V (m³): ω = e^{−e²/2}/(e^{−e²/2} + β), e² = |r|²/s²,
    β = ε/(1 − ε) (2π)^{d/2} s^d/V."""
    residual = torch.where(block.mask.unsqueeze(-1), block.residual, 0.0)
    d = residual.shape[-1]
    level = share / (1 - share) * (2 * math.pi) ** (0.5 * d) / volume
    beta = level * variance.sqrt() ** d
    gauss = torch.exp(-0.5 * residual.square().sum(-1) / variance)
    inliers = torch.where(block.mask, gauss / (gauss + beta), 0.0)
    weighted = (inliers / variance)[..., None, None] * block.jacobian
    rows, weighted = block.jacobian.flatten(-3, -2), weighted.flatten(-3, -2)
    return LandmarkFit(
        information=weighted.mT @ rows,
        gradient=(weighted.mT @ residual.flatten(-2).unsqueeze(-1))[..., 0],
        log_density=torch.where(block.mask, (gauss + beta).log(), 0.0).sum(-1),
        inliers=inliers,
    )
