"""Stein variational gradient descent on groups of poses (Liu & Wang 2016; CSPF paper, eq. 15).

Distances and repulsions are products of matrices: a cloud of poses is a cloud of points
[t/s_p, R/(√2 s_r)], all agents side by side, whose squared distances are |Δt|²/s_p² +
(2 sin ½angle)²/s_r².
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
    """k = exp(−q²/2h²) between particles, h² by the median rule h² = median(q²)/(2 log(m+1)), and
    the particles' positions and rotations that it was made from."""

    k: Float64[Tensor, "B H m m"]
    h: Float64[Tensor, "B H"]
    position: Float64[Tensor, "B H m N d"]
    rotation: Float64[Tensor, "B H m N d d"]


def kernel(poses: type[Poses], x: Float64[Tensor, "B H N m P"], scale: Scale) -> Kernel:
    """The kernel of q² = Σ |Δt|²/s_p² + (2 sin ½angle)²/s_r² over all agents (UAV 0, which is where
    it is by definition, adds nothing)."""
    position, attitude = poses.split(x.transpose(2, 3))
    rotation = rotation_matrix(attitude)
    here = position.flatten(-2) / scale.position[..., None, None]
    turned = rotation.flatten(-3) / (math.sqrt(2) * scale.turn[..., None, None])
    points = torch.cat((here, turned), -1)
    lengths = points.square().sum(-1)
    products = points @ points.mT
    q = (lengths.unsqueeze(-1) + lengths.unsqueeze(-2) - 2 * products).clamp_min(0.0)
    median = q.flatten(-2).median(-1).values
    h = (median / (2 * math.log(q.shape[-1] + 1))).clamp_min(1e-12)
    return Kernel(torch.exp(q * (-0.5 / h)[..., None, None]), h, position, rotation)


def stein_step(
    near: Kernel,
    steps: Float64[Tensor, "B H m N D"],
    density: Float64[Tensor, "B H m N 2"],
    repulsion: float,
) -> Float64[Tensor, "B H m N D"]:
    """The direction Φ of eq. 15, preconditioned: the kernel-weighted mean of the particles' own
    Gauss–Newton ``steps``, and ``repulsion`` times the kernel's gradient over the ``density`` of
    information (of position and turn, in units of the scale's).

    Tangents of different particles are averaged in the frame that they share, not in their own.
    """
    rotation, d = near.rotation, near.position.shape[-1]
    total = near.k.sum(-1)
    apart = total[..., None, None] * near.position - _mixed(near.k, near.position)
    turned = rotation.mT @ _mixed(near.k, rotation)
    push = (_into(rotation, apart), -_axis(turned))
    parts = []
    for part, moved in enumerate((steps[..., :d], steps[..., d:])):
        alike = part == 1 and d == 2  # a turn in the plane is the same in any frame
        shared = moved if alike else _out(rotation, moved)
        pull = _mixed(near.k, shared)
        pull = pull if alike else _into(rotation, pull)
        away = repulsion / (near.h[..., None, None] * density[..., part])
        parts.append((pull + away.unsqueeze(-1) * push[part]) / total[..., None, None])
    return torch.cat(parts, -1)


def mean_over(near: Kernel, values: Float64[Tensor, "B H m E"]) -> Float64[Tensor, "B H m E"]:
    """Kernel-weighted means of what particles have beside their poses."""
    return _mixed(near.k, values) / near.k.sum(-1, keepdim=True)


def _mixed(k: Float64[Tensor, "B H m m"], values: Float64[Tensor, "B H m *x"]) -> Tensor:
    """Σ_r k_lr v_r."""
    return (k @ values.flatten(3)).unflatten(-1, values.shape[3:])


def _out(rotation: Tensor, v: Tensor) -> Tensor:
    """Body-frame vectors in the shared frame."""
    return (rotation * v.unsqueeze(-2)).sum(-1)


def _into(rotation: Tensor, v: Tensor) -> Tensor:
    """Vectors of the shared frame in body frames."""
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
