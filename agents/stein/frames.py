"""Poses as matrices, so that one pose acts on many others by a single product."""

import torch
from jaxtyping import Float64
from torch import Tensor

from coloc_env.geometry import Poses, cross_matrix, join, rotation_matrix


def inverse_action(
    poses: type[Poses], x: Float64[Tensor, "*s P"]
) -> tuple[Float64[Tensor, "*s d d"], Float64[Tensor, "*s P P"], Float64[Tensor, "*s P"]]:
    """Rotation R, and A, b with ``x⁻¹ y = A y + b`` of the numbers stored for any pose y; in the
    plane the heading is not wrapped."""
    position, attitude = poses.split(x)
    rotation = rotation_matrix(attitude)
    if poses.dim == 2:
        turning, turned = torch.ones_like(attitude).unsqueeze(-1), -attitude
    else:
        turning, turned = _product_with_conjugate(attitude), torch.zeros_like(attitude)
    a = x.new_zeros(*x.shape, x.shape[-1])
    a[..., : poses.dim, : poses.dim] = rotation.mT
    a[..., poses.dim :, poses.dim :] = turning
    shift = -(rotation.mT @ position.unsqueeze(-1))[..., 0]
    return rotation, a, torch.cat((shift, turned), -1)


def adjoint(
    x: Float64[Tensor, "*s P"], rotation: Float64[Tensor, "*s d d"]
) -> Float64[Tensor, "*s D D"]:
    """Ad(x) = [[R, [t]× R], [0, R]], in the plane [[R, (y, −x)ᵀ], [0, 1]]; as ``Poses.adjoint``
    from the rotation at hand."""
    d = rotation.shape[-1]
    if d == 2:
        lever, turning = join((x[..., 1], -x[..., 0])).unsqueeze(-1), torch.ones_like(x[..., :1])
    else:
        lever, turning = cross_matrix(x[..., :3]) @ rotation, rotation
    full = x.new_zeros(*x.shape[:-1], d + lever.shape[-1], d + lever.shape[-1])
    full[..., :d, :d], full[..., :d, d:] = rotation, lever
    full[..., d:, d:] = turning.reshape(*x.shape[:-1], lever.shape[-1], -1)
    return full


def _product_with_conjugate(q: Float64[Tensor, "*s 4"]) -> Float64[Tensor, "*s 4 4"]:
    """The matrix of ``q* ⊗``."""
    w, x, y, z = q.unbind(-1)
    a, b, c = (-q[..., 1:]).unbind(-1)
    return join((w, x, y, z, a, w, z, b, b, c, w, x, c, y, a, w)).unflatten(-1, (4, 4))
