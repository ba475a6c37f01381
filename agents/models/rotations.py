"""Quaternion algebra at both sizes that localizers need; conventions of ``coloc_env.geometry``.

The Hamilton product and the rotation matrix are linear in the outer product of two quaternions. For
the states of Kalman filters one product with a constant matrix saves some thirty operations, whose
cost is their number; for clouds of particles ``geometry``'s elementwise forms are faster.
"""

from collections.abc import Sequence
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from coloc_env import geometry

# States have these dimensions (B, N, k), clouds more. The batch's size must not decide: both forms
# round differently, and a row's numbers would depend on who else is in the batch.
_STATES = 3


@lru_cache
def _product_map(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "16 4"]:
    """outer(a, b) → a ⊗ b, from the products of the basis quaternions."""
    basis = torch.eye(4, dtype=dtype, device=device)
    pairs = geometry.quaternion_product(
        basis.unsqueeze(1).expand(4, 4, 4), basis.unsqueeze(0).expand(4, 4, 4)
    )
    return pairs.reshape(16, 4).contiguous()


@lru_cache
def _matrix_map(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "16 9"]:
    """outer(q, q) → the rotation matrix, row by row: its columns are q ⊗ e ⊗ q*."""
    basis = torch.eye(4, dtype=dtype, device=device)
    left = basis.unsqueeze(1).expand(4, 4, 4)
    right = geometry.quaternion_conjugate(basis).unsqueeze(0).expand(4, 4, 4)
    columns = []
    for axis in (1, 2, 3):
        turned = geometry.quaternion_product(
            geometry.quaternion_product(left, basis[axis].expand(4, 4, 4)), right
        )
        columns.append(turned[..., 1:].reshape(16, 3))
    return torch.stack(columns, -1).reshape(16, 9).contiguous()


def _bilinear(
    matrix: Float[Tensor, "16 k"], a: Float[Tensor, "*s 4"], b: Float[Tensor, "*s 4"]
) -> Float[Tensor, "*s k"]:
    # One row a state: products with one column go a way of their own and round differently.
    outer = a.unsqueeze(-1) * b.unsqueeze(-2)
    return (outer.reshape(-1, 16) @ matrix).view(*outer.shape[:-2], -1)


def concat(parts: Sequence[Float[Tensor, "*s _"]]) -> Float[Tensor, "*s n"]:
    """Vectors side by side in the last dimension; those of clouds in ``geometry``'s memory order,
    which costs three operations a part more."""
    if parts[0].dim() > _STATES:
        return geometry.concat(tuple(parts))
    return torch.cat(tuple(parts), -1)


def product(a: Float[Tensor, "*s 4"], b: Float[Tensor, "*s 4"]) -> Float[Tensor, "*s 4"]:
    """Hamilton product ``a ⊗ b``."""
    if b.dim() > _STATES:
        return geometry.quaternion_product(a, b)
    return _bilinear(_product_map(a.dtype, a.device), a, b)


def matrix(attitude: Float[Tensor, "*s a"]) -> Float[Tensor, "*s d d"]:
    """Body-to-world matrix of a quaternion or heading."""
    if attitude.shape[-1] == 1 or attitude.dim() > _STATES:
        return geometry.rotation_matrix(attitude)
    flat = _bilinear(_matrix_map(attitude.dtype, attitude.device), attitude, attitude)
    return flat.unflatten(-1, (3, 3))


def exp(v: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 4"]:
    """Rotation vector (rad) to unit quaternion."""
    if v.dim() > _STATES:
        return geometry.quaternion_exp(v)
    half = 0.5 * torch.linalg.vector_norm(v, dim=-1, keepdim=True)
    return concat((half.cos(), 0.5 * torch.sinc(half / torch.pi) * v))


def rotate(attitude: Float[Tensor, "*s a"], v: Float[Tensor, "*s d"]) -> Float[Tensor, "*s d"]:
    """A body-frame vector in the world frame."""
    if v.dim() > _STATES:
        return geometry.rotate(attitude, v)
    return (matrix(attitude) * v.unsqueeze(-2)).sum(-1)


def rotate_by(
    attitude: Float[Tensor, "*s a"], delta: Float[Tensor, "*s t"]
) -> Float[Tensor, "*s a"]:
    """``attitude ⊞ delta``: a right (body-frame) perturbation."""
    if attitude.shape[-1] == 1:
        return geometry.rotate_by(attitude, delta)
    turned = product(attitude, exp(delta))
    return turned / (turned * turned).sum(-1, keepdim=True).sqrt()


def rotation_between(
    start: Float[Tensor, "*s a"], end: Float[Tensor, "*s a"]
) -> Float[Tensor, "*s t"]:
    """``end ⊟ start``: the body-frame rotation vector that takes ``start`` to ``end``."""
    if start.shape[-1] == 1:
        return geometry.rotation_between(start, end)
    return geometry.quaternion_log(product(geometry.quaternion_conjugate(start), end))
