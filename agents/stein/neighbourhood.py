"""The paper's own target (eq. 16): particles of one holder against those of the other."""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.stein.likelihood import Fit, Scale
from agents.stein.match_window import MatchWindow
from coloc_env.geometry import Poses, pair_distances

_NEAREST = 5  # particles that make up a neighbourhood


def fit_neighbours(
    poses: type[Poses],
    x: Float64[Tensor, "B H N m P"],
    window: MatchWindow,
    scale: Scale,
    beta: Float64[Tensor, "B H"],
    talking: Bool[Tensor, "B H R"],
) -> Fit:
    """Equation 16: log P_Q = −Σ_k d_kᵀ Σ d_k, d_k = log(p_{j,k}⁻¹ (p_{i,r} T)), each holder's
    particles of its own pose, transformed by a match, against the nearest of its partner's own
    particles.

    A holder's entries for other agents have no likelihood. With ``beta`` 0 every match is an
    inlier.
    """
    n, m = x.shape[2:4]
    holder = torch.arange(n, device=x.device)
    own = x[:, holder, holder]  # [B, H, m, P]
    first = window.first == holder.unsqueeze(-1)
    partner = torch.where(first, window.second, window.first)
    toward = torch.where(first.unsqueeze(-1), window.pose, poses.inverse(window.pose)).unsqueeze(-2)
    predicted = poses.compose(own.unsqueeze(2), toward)  # [B, H, W, m, P]
    index = partner.flatten(1)[..., None, None].expand(-1, -1, m, poses.size)
    there = own.gather(1, index).unflatten(1, partner.shape[1:])
    squared, angle = pair_distances(poses, predicted, there)
    one = (s.square()[..., None, None, None] for s in (scale.position, scale.turn))
    distance, nearest = (squared / next(one) + angle / next(one)).topk(
        min(_NEAREST, m), -1, largest=False
    )
    wide = nearest.flatten(-2).unsqueeze(-1).expand(-1, -1, -1, -1, poses.size)
    near = there.gather(3, wide).unflatten(3, nearest.shape[-2:])
    step = poses.minus(near, predicted.unsqueeze(-2)).mean(-2)
    gauss = torch.exp(-0.5 * distance.mean(-1))
    mask = (window.mask & talking.gather(2, partner)).unsqueeze(-1)
    level = beta[..., None, None]
    inliers = torch.where(mask, torch.where(level > 0, gauss / (gauss + level), 1.0), 0.0)
    moved = (inliers.unsqueeze(-1) * poses.carry(toward, step)).sum(2)
    weight = inliers.sum(2)
    mine = torch.eye(n, dtype=x.dtype, device=x.device)[..., None]
    density = torch.where(level > 0, (gauss + level).log(), -0.5 * distance.mean(-1))
    return Fit(
        steps=mine.unsqueeze(-1) * moved.unsqueeze(2),
        weight=(mine * weight.unsqueeze(2)).unsqueeze(-1).expand(-1, -1, -1, -1, 2),
        log_density=torch.where(mask, density, 0.0).sum(2),
        inliers=inliers,
    )
