"""Weighing, pruning and merging the hypotheses of a bank of Kalman filters."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from agents.association import Candidates
from agents.association.clutter import CLUTTER, log_mixture
from agents.models.measurements import Block
from agents.models.process import Process
from agents.robust.heavy_tails import gaussian_log_density
from agents.robust.mahalanobis import innovation_terms

_FAR = 10.0  # m, rad: standard deviation of what they say
_WORST = -1e9  # of a log-weight: whatever else went wrong, some hypothesis is left
_LEAST = math.log(1e-8)  # of a weight: what is less likely is given up
_CLOSE = 0.25  # squared distance per error of the pose below which two hypotheses are one


def log_predictive(block: Block, covariance: Float64[Tensor, "B N E E"]) -> Float64[Tensor, "B N"]:
    """Σ log p(z) of a block's measurements, each (1 − ε) N(ν; 0, S) + ε N(ν; 0, 10² I); ties
    between measurements through the prior are left out."""
    size = block.residual.shape[-1]
    near = _log_normal(*innovation_terms(block, covariance))
    wide = gaussian_log_density((block.residual**2).sum(-1) / _FAR**2, size)
    wide = wide - size * math.log(_FAR)
    both = torch.logaddexp(near + math.log1p(-CLUTTER), wide + math.log(CLUTTER))
    return both.masked_fill(~block.mask, 0.0).sum(-1)


def log_any_landmark(found: Candidates, volume: float) -> Float64[Tensor, "B N"]:
    """Σ log p(z) of landmark vectors without names: ε / V + (1 − ε) / L · Σ_l N(z; ẑ_l, S_l)."""
    each = gaussian_log_density(found.squared, found.z.shape[-1])
    each = each - 0.5 * found.log_det.unsqueeze(-2)
    return log_mixture(each, volume).masked_fill(~found.mask, 0.0).sum(-1)


def _log_normal(terms: Sequence[Tensor], pivots: Sequence[Tensor]) -> Tensor:
    each = [t + p.log() for t, p in zip(terms, pivots, strict=True)]
    return gaussian_log_density(sum(each[1:], each[0]), len(each))


def reweighed(log_weights: Float64[Tensor, "B N K"]) -> Float64[Tensor, "B N K"]:
    """Normalized log-weights; −∞ for those below 1e-8, which are given up, and whose numbers are
    no longer finite."""
    log_weights = log_weights.nan_to_num(nan=-torch.inf).clamp_min(_WORST).log_softmax(-1)
    return log_weights.masked_fill(log_weights < _LEAST, -torch.inf).log_softmax(-1)


def merged(
    process: Process,
    state: Float64[Tensor, "B N K S"],
    covariance: Float64[Tensor, "B N K E E"],
    log_weights: Float64[Tensor, "B N K"],
) -> Float64[Tensor, "B N K"]:
    """Log-weights after hypotheses have gone over to a likelier one whose pose is the same: closer
    than half a standard deviation per direction by the likelier one's covariance."""
    pose = process.pose_errors
    k = log_weights.shape[-1]
    wide = (*state.shape[:2], k, k, state.shape[-1])
    apart = process.boxminus(state.unsqueeze(3).expand(wide), state.unsqueeze(2).expand(wide))
    root = torch.linalg.cholesky_ex(covariance[..., pose, :][..., pose]).L
    # apart[j, i] of j from i, whitened by i's covariance
    scaled = torch.linalg.solve_triangular(
        root, apart[..., pose].permute(0, 1, 3, 4, 2), upper=False
    )
    close = (scaled.square().sum(-2) < _CLOSE * len(pose)).mT  # [B, N, j, i]
    ahead = _ahead(log_weights)
    close = close & ahead & (log_weights > -torch.inf).unsqueeze(-1)
    goes = close.any(-1)
    target = torch.where(close, log_weights.unsqueeze(-2), -torch.inf).argmax(-1)
    goes = goes & ~goes.gather(-1, target)  # whoever goes itself takes nobody up in this step
    weights = log_weights.exp()
    gained = torch.zeros_like(weights).scatter_add_(-1, target, weights * goes)
    return (weights + gained).log().masked_fill(goes, -torch.inf)


def _ahead(log_weights: Float64[Tensor, "B N K"]) -> Bool[Tensor, "B N K K"]:
    """Whether i comes before j in the order of weights, [j, i]."""
    rank = by_weight(log_weights).argsort(-1)
    return rank.unsqueeze(-2) < rank.unsqueeze(-1)


def by_weight(log_weights: Float64[Tensor, "B N K"]) -> Int64[Tensor, "B N K"]:
    """The order of hypotheses, the likeliest first."""
    return log_weights.argsort(dim=-1, descending=True, stable=True)
