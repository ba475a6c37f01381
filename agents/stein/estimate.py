"""A holder's estimate: the mean around its best particle, and its covariance by the window."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.stein.likelihood import Factors, Scale
from agents.stein.match_window import MatchWindow, agents_of
from coloc_env.geometry import Poses


class Manifold(NamedTuple):
    """``x ⊞ ξ`` and ``y ⊟ x`` of whole states, as ``Poses`` has them of poses."""

    plus: Callable[[Tensor, Tensor], Tensor]
    minus: Callable[[Tensor, Tensor], Tensor]


States = type[Poses] | Manifold


def map_estimate(
    poses: States,
    x: Float64[Tensor, "B H N m P"],
    log_density: Float64[Tensor, "B H m"],
    k: Float64[Tensor, "B H m m"],
) -> Float64[Tensor, "B H N P"]:
    """Kernel-weighted intrinsic mean around the densest particle (Algorithm 1, line 8)."""
    best = log_density.argmax(-1)[..., None, None]
    weight = k.gather(2, best.expand(-1, -1, -1, k.shape[-1]))  # [B, H, 1, m]
    weight = weight / weight.sum(-1, keepdim=True)
    index = best.unsqueeze(-1).expand(-1, -1, x.shape[2], 1, x.shape[-1])
    centre = x.gather(3, index)
    mean = (weight.unsqueeze(-1) * poses.minus(x, centre)).sum(3)
    return poses.plus(centre[..., 0, :], mean)


def covariance(
    poses: type[Poses],
    estimate: Float64[Tensor, "B H N P"],
    window: MatchWindow,
    inliers: Float64[Tensor, "B H W"],
    known: Factors,
    scale: Scale,
    prior: Float64[Tensor, "D"],
) -> Float64[Tensor, "B N D D"]:
    """Each holder's covariance of its own pose, in its tangent: the inverse of the Gauss–Newton
    information Jᵀ W J + Λ of its window about the estimate. ``prior``: variances of a uniform pose.
    UAV 0 is known. The variance of odometry since is common to all matches and is added in full."""
    n, d = estimate.shape[2], poses.dof
    at_first, at_second = known.at_first.mT, known.at_second.mT
    first, second = (agents_of(estimate, index) for index in (window.first, window.second))
    back = poses.adjoint(poses.between(second, first))  # [B, H, W, D, D]
    eye = torch.eye(d, dtype=estimate.dtype, device=estimate.device)
    jacobian = (
        at_second[..., None, :, None] * eye.unsqueeze(-2)
        - at_first[..., None, :, None] * back.unsqueeze(-2)
    ).flatten(-2)  # [B, H, W, D, N·D]
    turns = d - poses.dim
    std = torch.stack((scale.position,) * poses.dim + (scale.turn,) * turns, -1).unsqueeze(2)
    factor = known.variance.sqrt()
    factor = torch.cat((factor[..., :1],) * poses.dim + (factor[..., 1:],) * turns, -1)
    weight = inliers.sqrt().unsqueeze(-1) / (std * factor)
    rows = (weight.unsqueeze(-1) * jacobian).flatten(2, 3)
    precision = (1 / prior).repeat(n)
    precision[:d] = precision[:d] * 1e12
    joint = torch.linalg.inv(rows.mT @ rows + torch.diag(precision))
    own = torch.arange(n, device=estimate.device)
    blocks = joint.unflatten(-1, (n, d)).unflatten(2, (n, d))[:, own, own, :, own].movedim(0, 1)
    share = (inliers / inliers.sum(-1, keepdim=True).clamp_min(1e-9)).unsqueeze(-1)
    drift = (share * window.added_variance).sum(2)
    return blocks + torch.diag_embed(
        torch.cat((drift[..., :1],) * poses.dim + (drift[..., 1:],) * turns, -1)
    )
