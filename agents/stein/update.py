"""Stein variational gradient descent (SVGD) on groups of poses (Liu & Wang 2016; CSPF paper,
equation 15).

Distances and repulsions are products of matrices: poses are embedded as points
[t/s_p, R/(√2 s_r)], all agents side by side, whose squared distances are |Δt|²/s_p² +
(2 sin ½θ)²/s_r².
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.stein.likelihood import Scale
from coloc_env.geometry import Poses, rotation_matrix


@dataclass(frozen=True)
class Kernel:
    """k = exp(−q²/2h²) between particles, ``bandwidth`` h² = median(q²)/(2 log(m+1)) (the median
    rule), and the particles' positions and rotations."""

    k: Float64[Tensor, "B H m m"]
    bandwidth: Float64[Tensor, "B H"]
    position: Float64[Tensor, "B H m N d"]
    rotation: Float64[Tensor, "B H m N d d"]


def kernel(poses: type[Poses], x: Float64[Tensor, "B H N m P"], scale: Scale) -> Kernel:
    """The kernel of q² = Σ |Δt|²/s_p² + (2 sin ½θ)²/s_r² over all agents (UAV 0, which is the
    reference, adds nothing)."""
    position, attitude = poses.split(x.transpose(2, 3))
    rotation = rotation_matrix(attitude)
    scaled = position.flatten(-2) / scale.position[..., None, None]
    turned = rotation.flatten(-3) / (math.sqrt(2) * scale.turn[..., None, None])
    points = torch.cat((scaled, turned), -1)
    lengths = points.square().sum(-1)
    products = points @ points.mT
    q = (lengths.unsqueeze(-1) + lengths.unsqueeze(-2) - 2 * products).clamp_min(0.0)
    median = q.flatten(-2).median(-1).values
    bandwidth = (median / (2 * math.log(q.shape[-1] + 1))).clamp_min(1e-12)
    return Kernel(torch.exp(q * (-0.5 / bandwidth)[..., None, None]), bandwidth, position, rotation)


def stein_step(
    near: Kernel,
    steps: Float64[Tensor, "B H m N D"],
    information: Float64[Tensor, "B H m N 2"],
    repulsion: float,
) -> Float64[Tensor, "B H m N D"]:
    """The direction φ* of equation 15, preconditioned: Σ_r k_lr s_r / Σ_r k_lr of the particles'
    Gauss–Newton ``steps`` s (equation 17), and ``repulsion`` times Σ_r ∇k_lr over their
    ``information`` (of position and turn, in units of the scale's).

    Tangents of different particles are averaged in a common frame, not in their own.
    """
    rotation, d = near.rotation, near.position.shape[-1]
    total = near.k.sum(-1)
    push = repulsions(near)
    parts = []
    for part, moved in enumerate((steps[..., :d], steps[..., d:])):
        planar = part == 1 and d == 2  # a rotation in the plane is the same in any frame
        shared = moved if planar else to_world(rotation, moved)
        pull = _weighted_sum(near.k, shared)
        pull = pull if planar else to_body(rotation, pull)
        away = repulsion / (near.bandwidth[..., None, None] * information[..., part])
        parts.append((pull + away.unsqueeze(-1) * push[part]) / total[..., None, None])
    return torch.cat(parts, -1)


def repulsions(near: Kernel) -> tuple[Float64[Tensor, "B H m N d"], Float64[Tensor, "B H m N t"]]:
    """h² Σ_r ∇k_lr of positions and of rotations, in units of the scale, in body frames."""
    total = near.k.sum(-1)
    gradient = total[..., None, None] * near.position - _weighted_sum(near.k, near.position)
    turned = near.rotation.mT @ _weighted_sum(near.k, near.rotation)
    return to_body(near.rotation, gradient), -_axis(turned)


def mean_over(near: Kernel, values: Float64[Tensor, "B H m E"]) -> Float64[Tensor, "B H m E"]:
    """Kernel-weighted means of the particles' ``values``."""
    return _weighted_sum(near.k, values) / near.k.sum(-1, keepdim=True)


def _weighted_sum(k: Float64[Tensor, "B H m m"], values: Float64[Tensor, "B H m *x"]) -> Tensor:
    """Σ_r k_lr v_r."""
    return (k @ values.flatten(3)).unflatten(-1, values.shape[3:])


def to_world(rotation: Tensor, v: Tensor) -> Tensor:
    """Body-frame vectors in the common frame."""
    return (rotation * v.unsqueeze(-2)).sum(-1)


def to_body(rotation: Tensor, v: Tensor) -> Tensor:
    """Vectors of the common frame in body frames."""
    return (rotation * v.unsqueeze(-1)).sum(-2)


def _axis(m: Float64[Tensor, "*s d d"]) -> Float64[Tensor, "*s t"]:
    """Of a rotation, sin(angle) times its axis."""
    if m.shape[-1] == 2:
        return 0.5 * (m[..., 1, 0] - m[..., 0, 1]).unsqueeze(-1)
    return 0.5 * torch.stack(
        (
            m[..., 2, 1] - m[..., 1, 2],
            m[..., 0, 2] - m[..., 2, 0],
            m[..., 1, 0] - m[..., 0, 1],
        ),
        -1,
    )
