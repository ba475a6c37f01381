"""Likelihood of the matches in the window, and its Gauss–Newton steps (equation 17)."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.stein.frames import adjoint, inverse_action
from agents.stein.match_window import MatchWindow, agents_of
from coloc_env.geometry import Poses


@dataclass(frozen=True)
class Scale:
    """Annealed standard deviations of matches: ``position`` s_p (m), ``turn`` s_r (rad)."""

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
    """The window as factors, computed once a step, so that iterations are products of matrices.

    ``at_first``, ``at_second``: incidence of agents (0 or 1); ``variance`` v in units of the
    scale's (of position and turn); ``inverse`` and ``offset``: y ↦ T⁻¹ y of the numbers of a pose;
    ``to_steps``: from residuals to the sums of steps at each agent; ``to_weights``: from
    responsibilities to the sums of weights.
    """

    at_first: Float64[Tensor, "B H N W"]
    at_second: Float64[Tensor, "B H N W"]
    variance: Float64[Tensor, "B H W 2"]
    inverse: Float64[Tensor, "B H W P P"]
    offset: Float64[Tensor, "B H W P"]
    to_steps: Float64[Tensor, "B H N*D W*D"]
    to_weights: Float64[Tensor, "B H N*2 W"]


def outlier_level(
    poses: type[Poses], scale: Scale, share: float, volume: float
) -> Float64[Tensor, "B H"]:
    """β = ε/(1 − ε) · (2π)^{D/2} s_p^d s_r^n / V: an outlier's density over the peak of an
    inlier's."""
    turns = poses.dof - poses.dim
    peak = (2 * math.pi) ** (0.5 * poses.dof) * scale.position**poses.dim * scale.turn**turns
    return share / (1 - share) * peak / volume


def factors(poses: type[Poses], window: MatchWindow, scale: Scale, agents: int) -> Factors:
    """The factors of the window, and the weight of each end's step.

    The second end's step is in the first one's frame; the first end's has the rotation's error
    times |t| in addition.
    """
    one = torch.stack((scale.position, scale.turn), -1).square().unsqueeze(2)
    variance = 1 + window.added_variance / one
    position, turn = variance.unbind(-1)
    lever = poses.split(window.pose)[0].square().sum(-1) * one[..., 1] / one[..., 0]
    index = torch.arange(agents, device=position.device).unsqueeze(-1)
    at_first = (window.first.unsqueeze(-2) == index).to(position.dtype)
    at_second = (window.second.unsqueeze(-2) == index).to(position.dtype)
    first = torch.stack((1 / (position + lever * turn), 1 / turn), -2)
    first = at_first.unsqueeze(3) * first.unsqueeze(2)  # [B, H, N, 2, W]
    second = at_second.unsqueeze(3) / variance.mT.unsqueeze(2)
    rotation, inverse, offset = inverse_action(poses, window.pose)
    return Factors(
        at_first=at_first,
        at_second=at_second,
        variance=variance,
        inverse=inverse,
        offset=offset,
        to_steps=_to_steps(window.pose, rotation, first, second),
        to_weights=(first + second).flatten(2, 3),
    )


def _to_steps(
    pose: Float64[Tensor, "B H W P"],
    rotation: Float64[Tensor, "B H W d d"],
    first: Float64[Tensor, "B H N 2 W"],
    second: Float64[Tensor, "B H N 2 W"],
) -> Float64[Tensor, "B H N*D W*D"]:
    """Ad(T) r at first ends, −r at second ones, each with its weight."""
    back = adjoint(pose, rotation)
    d, dof = rotation.shape[-1], back.shape[-1]
    part = (torch.arange(dof, device=back.device) >= d).long()
    eye = torch.eye(dof, dtype=back.dtype, device=back.device).unsqueeze(1)
    first, second = (each[:, :, :, part].unsqueeze(-1) for each in (first, second))
    return (first * back.transpose(2, 3).unsqueeze(2) - second * eye).flatten(4).flatten(2, 3)


def residuals(
    poses: type[Poses],
    x: Float64[Tensor, "B H N m P"],
    window: MatchWindow,
    known: Factors,
    scale: Scale,
    beta: Float64[Tensor, "B H"],
) -> tuple[Tensor, Float64[Tensor, "B H W m"], Float64[Tensor, "B H m"]]:
    """A mixture of Gaussian matches and uniform outliers, from the joint residual
    r = log(T⁻¹ x_i⁻¹ x_j) between a particle's own entries: r [B, H, W, m, D], responsibilities,
    and the log-density up to a constant."""
    d = poses.dim
    between = poses.between(agents_of(x, window.first), agents_of(x, window.second))
    there = known.inverse @ between.mT + known.offset.unsqueeze(-1)
    residual = poses.log(there.mT)
    squares = residual.square()
    one = torch.stack((scale.position, scale.turn), -1).square().unsqueeze(2) * known.variance
    distance = squares[..., :d].sum(-1) / one[..., :1] + squares[..., d:].sum(-1) / one[..., 1:]
    gauss = torch.exp(-0.5 * distance)
    mixed = gauss + beta[..., None, None]
    mask = window.mask.unsqueeze(-1)
    inliers = torch.where(mask, gauss / mixed, 0.0)
    return residual, inliers, torch.where(mask, mixed.log(), 0.0).sum(-2)


def fit(
    poses: type[Poses],
    x: Float64[Tensor, "B H N m P"],
    window: MatchWindow,
    known: Factors,
    scale: Scale,
    beta: Float64[Tensor, "B H"],
) -> Fit:
    """Gauss–Newton steps of the matches at their ends.

    Because J_r(r) r = r, the Gauss–Newton step of one factor needs no solve: it is −r at x_j and
    Ad(T) r at x_i (eq. 17).
    """
    residual, inliers, log_density = residuals(poses, x, window, known, scale, beta)
    weighted = (inliers.unsqueeze(-1) * residual).mT.flatten(2, 3)
    steps = (known.to_steps @ weighted).unflatten(2, (-1, poses.dof)).mT
    weight = (known.to_weights @ inliers).unflatten(2, (-1, 2)).mT
    return Fit(steps, weight, log_density, inliers)
