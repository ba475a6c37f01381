"""Stein variational gradient descent on groups of poses (Liu & Wang 2016; CSPF paper, eq. 15)."""

import math

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.stein.likelihood import Scale
from coloc_env.geometry import Poses, concat, pair_differences, pair_distances, rotate, unrotate


def kernel(
    poses: type[Poses], x: Float64[Tensor, "B H N m P"], scale: Scale
) -> tuple[Float64[Tensor, "B H m m"], Float64[Tensor, "B H"]]:
    """k = exp(−q²/2h²) between particles, and h² by the median rule h² = median(q²)/(2 log(m+1)).

    q² = Σ |Δt|²/s_p² + angle²/s_r² over the agents beside UAV 0, which is where it is by
    definition.
    """
    squared, angle = pair_distances(poses, x[:, :, 1:], x[:, :, 1:])
    one = scale.position.square()[..., None, None], scale.turn.square()[..., None, None]
    q = squared.sum(2) / one[0] + angle.sum(2) / one[1]
    m = q.shape[-1]
    median = q.flatten(-2).median(-1).values
    h = (median / (2 * math.log(m + 1))).clamp_min(1e-12)
    return torch.exp(-0.5 * q / h[..., None, None]), h


def stein_step(
    poses: type[Poses],
    x: Float64[Tensor, "B H N m P"],
    steps: Float64[Tensor, "B H N m D"],
    density: Float64[Tensor, "B H N m"],
    k: Float64[Tensor, "B H m m"],
    h: Float64[Tensor, "B H"],
    repulsion: float,
) -> Float64[Tensor, "B H N m D"]:
    """The direction Φ of eq. 15, preconditioned: the kernel-weighted mean of the particles' own
    Gauss–Newton ``steps``, and the kernel's repulsion divided by h² and by the ``density`` of
    information (what the target's curvature is in units of the kernel's scale).

    Tangents of different particles are averaged in the frame that they share, not in their own.
    """
    total = k.sum(-1)[:, :, None, :, None]
    attitude = poses.split(x)[1]
    shared = k.unsqueeze(2) @ _turned(poses, rotate, attitude, steps)
    pull = _turned(poses, unrotate, attitude, shared)
    apart = pair_differences(poses, x, x, k.unsqueeze(2).expand(-1, -1, x.shape[2], -1, -1))
    push = apart / (h[..., None, None] * density).unsqueeze(-1)
    return (pull - repulsion * push) / total


def _turned(poses, turn, attitude, tangents):  # type: ignore[no-untyped-def]
    """Both parts of tangent vectors rotated."""
    rho, phi = tangents[..., : poses.dim], tangents[..., poses.dim :]
    turned = phi if poses.dim == 2 else turn(attitude, phi)
    return concat((turn(attitude, rho), turned))
