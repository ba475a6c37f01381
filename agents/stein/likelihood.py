"""How well poses fit the matches remembered, and where Gauss–Newton would move them."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.stein.window import Window, agents_of
from coloc_env.geometry import Poses


@dataclass(frozen=True)
class Scale:
    """Standard deviations that matches count with at present: m and rad, [B, H]."""

    position: Float64[Tensor, "B H"]
    turn: Float64[Tensor, "B H"]


@dataclass(frozen=True)
class Fit:
    """``steps``: Σ (ω/v) · Gauss–Newton step of each factor at each agent, ``weight``: Σ ω/v,
    ``log_density`` up to a constant, ``inliers``: each match's responsibility ω."""

    steps: Float64[Tensor, "B H N m D"]
    weight: Float64[Tensor, "B H N m"]
    log_density: Float64[Tensor, "B H m"]
    inliers: Float64[Tensor, "B H W m"]


def outlier_level(
    poses: type[Poses], scale: Scale, share: float, volume: float
) -> Float64[Tensor, "B H"]:
    """β = ε/(1 − ε) · (2π)^{D/2} s_p^d s_r^n / V: an outlier's density over the peak of an
    inlier's."""
    turns = poses.dof - poses.dim
    peak = (2 * math.pi) ** (0.5 * poses.dof) * scale.position**poses.dim * scale.turn**turns
    return share / (1 - share) * peak / volume


def fit(
    poses: type[Poses],
    x: Float64[Tensor, "B H N m P"],
    window: Window,
    scale: Scale,
    beta: Float64[Tensor, "B H"],
) -> Fit:
    """A mixture of Gaussian matches and uniform outliers, from the joint residual
    r = log(T⁻¹ x_i⁻¹ x_j) between a particle's own entries.

    Because J_r(r) r = r, the Gauss–Newton step of one factor needs no solve: it is −r at x_j and
    Ad(T) r at x_i (eq. 17).
    """
    pose = window.pose.unsqueeze(-2)
    between = poses.between(agents_of(x, window.first), agents_of(x, window.second))
    residual = poses.minus(between, pose)
    squares = residual.square()
    variance = window.spread.unsqueeze(-1)
    one = scale.position.square()[..., None, None], scale.turn.square()[..., None, None]
    distance = squares[..., : poses.dim].sum(-1) / one[0] + squares[..., poses.dim :].sum(-1) / one[1]
    gauss = torch.exp(-0.5 * distance / variance)
    mixed = gauss + beta[..., None, None]
    held = window.held.unsqueeze(-1)
    inliers = torch.where(held, gauss / mixed, 0.0)
    weight = inliers / variance
    weighted = weight.unsqueeze(-1) * residual
    m, n = x.shape[3], x.shape[2]
    agents = torch.arange(n, device=x.device)
    at_first = (window.first.unsqueeze(-2) == agents.unsqueeze(-1)).to(x.dtype)
    at_second = (window.second.unsqueeze(-2) == agents.unsqueeze(-1)).to(x.dtype)
    back = poses.carry(pose, weighted)
    steps = at_first @ back.flatten(-2) - at_second @ weighted.flatten(-2)
    log_density = torch.where(held, mixed.log(), 0.0).sum(-2)
    return Fit(steps.unflatten(-1, (m, -1)), (at_first + at_second) @ weight, log_density, inliers)
