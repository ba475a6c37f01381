"""Every pose of one cloud against every pose of another, by matrix products.

Kernels of particle filters need, of m × n pairs, only distances and weighted sums of differences.
Both come from products of m × d and d × n matrices; no m × n × d tensor is ever made. Positions and
attitudes are measured apart, as in R^d × SO(d).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from coloc_env.geometry.poses import Poses
from coloc_env.geometry.rotations import (
    concat,
    quaternion_conjugate,
    quaternion_product,
    unrotate,
)


def pair_distances(
    poses: type[Poses], x: Float[Tensor, "*s m P"], y: Float[Tensor, "*s n P"]
) -> tuple[Float[Tensor, "*s m n"], Float[Tensor, "*s m n"]]:
    """Squared distances (m²) and squared angles (rad², at most π²).

    Exact to about 1e-15 of the positions' own size squared: centre positions far from the origin.
    The angle is not differentiable where two attitudes are the same.
    """
    here, there = poses.split(x)[0], poses.split(y)[0]
    lengths = (here**2).sum(-1, keepdim=True) + (there**2).sum(-1).unsqueeze(-2)
    squared = (lengths - 2 * (here @ there.mT)).clamp(min=0)
    return squared, (2 * _half_cosines(poses, x, y).abs().clamp(max=1).acos()) ** 2


def pair_differences(
    poses: type[Poses],
    x: Float[Tensor, "*s m P"],
    y: Float[Tensor, "*s n P"],
    weights: Float[Tensor, "*s m n"],
) -> Float[Tensor, "*s m D"]:
    """``Σ_n w_mn [R_mᵀ (t_n − t_m), log(R_mᵀ R_n)]``: where the others lie, in x's body frame.

    The gradient of half the squared distances of ``pair_distances``, with a minus sign, by right
    perturbations of x. A logarithm is ``angle / sin(½ angle)`` times the imaginary part of
    ``q_m* ⊗ q_n``, and that is linear in ``q_n``.
    """
    here, there = poses.split(x)[0], poses.split(y)[0]
    position = weights @ there - weights.sum(-1, keepdim=True) * here
    cosine = _half_cosines(poses, x, y)
    size = cosine.abs().clamp(max=1)
    tiny = torch.finfo(x.dtype).tiny  # 0/0 where attitudes are the same, and then the ratio is 2
    ratio = 2 * (size.acos() + tiny) / (((1 - size) * (1 + size)).sqrt() + tiny)
    pulled = (weights * torch.where(cosine < 0, -ratio, ratio)) @ poses.quaternion(y)
    turn = quaternion_product(quaternion_conjugate(poses.quaternion(x)), pulled)
    return concat((unrotate(poses.split(x)[1], position), turn[..., poses.dim - poses.dof :]))


def _half_cosines(
    poses: type[Poses], x: Float[Tensor, "*s m P"], y: Float[Tensor, "*s n P"]
) -> Float[Tensor, "*s m n"]:
    """``cos ½ angle``, with the sign of the quaternions."""
    return poses.quaternion(x) @ poses.quaternion(y).mT
