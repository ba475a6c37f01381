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
    """``steps``: weighted sum of the factors' Gauss–Newton steps at each agent, ``weight`` the sum
    of weights (of position and turn, in units of the scale's information), ``log_density`` up to a
    constant, ``inliers``: each match's responsibility ω."""

    steps: Float64[Tensor, "B H N m D"]
    weight: Float64[Tensor, "B H N m 2"]
    log_density: Float64[Tensor, "B H m"]
    inliers: Float64[Tensor, "B H W m"]


@dataclass(frozen=True)
class Factors:
    """The window as factors, prepared once a step: who is at their ends (0 or 1), variances over
    those of the scale (position, turn), and the weights of their steps at either end."""

    at_first: Float64[Tensor, "B H N W"]
    at_second: Float64[Tensor, "B H N W"]
    variance: Float64[Tensor, "B H W 2"]
    first: Float64[Tensor, "B H W 2"]
    second: Float64[Tensor, "B H W 2"]


def outlier_level(
    poses: type[Poses], scale: Scale, share: float, volume: float
) -> Float64[Tensor, "B H"]:
    """β = ε/(1 − ε) · (2π)^{D/2} s_p^d s_r^n / V: an outlier's density over the peak of an
    inlier's."""
    turns = poses.dof - poses.dim
    peak = (2 * math.pi) ** (0.5 * poses.dof) * scale.position**poses.dim * scale.turn**turns
    return share / (1 - share) * peak / volume


def factors(poses: type[Poses], window: Window, scale: Scale, agents: int) -> Factors:
    """Who is where, and how much each end's step counts.

    The second end's step says where it is in the first one's frame; the first end's says where
    it must stand to see the second there, and is by |t| times the turn's error worse.
    """
    one = torch.stack((scale.position, scale.turn), -1).square().unsqueeze(2)
    variance = 1 + window.grown / one
    position, turn = variance.unbind(-1)
    lever = poses.split(window.pose)[0].square().sum(-1) * one[..., 1] / one[..., 0]
    index = torch.arange(agents, device=position.device).unsqueeze(-1)
    return Factors(
        at_first=(window.first.unsqueeze(-2) == index).to(position.dtype),
        at_second=(window.second.unsqueeze(-2) == index).to(position.dtype),
        variance=variance,
        first=torch.stack((1 / (position + lever * turn), 1 / turn), -1),
        second=1 / variance,
    )


def compare(
    poses: type[Poses],
    x: Float64[Tensor, "B H N m P"],
    window: Window,
    known: Factors,
    scale: Scale,
    beta: Float64[Tensor, "B H"],
) -> tuple[Tensor, Float64[Tensor, "B H W m"], Float64[Tensor, "B H m"]]:
    """A mixture of Gaussian matches and uniform outliers, from the joint residual
    r = log(T⁻¹ x_i⁻¹ x_j) between a particle's own entries: r [B, H, W, m, D], responsibilities,
    and the log-density up to a constant."""
    d = poses.dim
    between = poses.between(agents_of(x, window.first), agents_of(x, window.second))
    residual = poses.minus(between, window.pose.unsqueeze(-2))
    squares = residual.square()
    one = torch.stack((scale.position, scale.turn), -1).square().unsqueeze(2) * known.variance
    distance = squares[..., :d].sum(-1) / one[..., :1] + squares[..., d:].sum(-1) / one[..., 1:]
    gauss = torch.exp(-0.5 * distance)
    mixed = gauss + beta[..., None, None]
    held = window.held.unsqueeze(-1)
    inliers = torch.where(held, gauss / mixed, 0.0)
    return residual, inliers, torch.where(held, mixed.log(), 0.0).sum(-2)


def fit(
    poses: type[Poses],
    x: Float64[Tensor, "B H N m P"],
    window: Window,
    known: Factors,
    scale: Scale,
    beta: Float64[Tensor, "B H"],
) -> Fit:
    """Where matches would move their ends.

    Because J_r(r) r = r, the Gauss–Newton step of one factor needs no solve: it is −r at x_j and
    Ad(T) r at x_i (eq. 17).
    """
    d = poses.dim
    residual, inliers, log_density = compare(poses, x, window, known, scale, beta)
    weighted = inliers.unsqueeze(-1) * residual
    back = poses.carry(window.pose.unsqueeze(-2), weighted)
    weight, steps = [], []
    for part, cut in enumerate((slice(None, d), slice(d, None))):
        first = known.at_first * known.first[..., part].unsqueeze(-2)
        second = known.at_second * known.second[..., part].unsqueeze(-2)
        weight.append((first + second) @ inliers)
        moved = first @ back[..., cut].flatten(-2) - second @ weighted[..., cut].flatten(-2)
        steps.append(moved.unflatten(-1, (x.shape[3], -1)))
    return Fit(torch.cat(steps, -1), torch.stack(weight, -1), log_density, inliers)
