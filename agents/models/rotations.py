"""Quaternion algebra as matrix products, for the large clouds and small filters of localizers.

The Hamilton product and the rotation matrix are linear in the outer product of two quaternions, so
each is one multiplication by a constant matrix instead of some thirty elementwise operations. (The
world keeps to the elementwise forms of ``coloc_env.geometry``, whose last bit does not depend on
the batch.) Conventions as there.
"""

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from coloc_env import geometry


@lru_cache
def _product_map(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "16 4"]:
    """outer(a, b) → a ⊗ b, built by multiplying the basis quaternions."""
    basis = torch.eye(4, dtype=dtype, device=device)
    pairs = geometry.quaternion_product(basis.unsqueeze(1), basis.unsqueeze(0).expand(4, 4, 4))
    return pairs.reshape(16, 4)


@lru_cache
def _matrix_map(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "16 9"]:
    """outer(q, q) → the rotation matrix's rows: v ↦ q ⊗ v ⊗ q* for each basis vector."""
    basis = torch.eye(4, dtype=dtype, device=device)
    columns = []
    for axis in (1, 2, 3):
        turned = geometry.quaternion_product(
            geometry.quaternion_product(basis.unsqueeze(1), basis[axis].expand(4, 1, 4)),
            geometry.quaternion_conjugate(basis).unsqueeze(0).expand(4, 4, 4),
        )
        columns.append(turned[..., 1:].reshape(16, 3))
    return torch.stack(columns, -1).reshape(16, 9)


def _outer(a: Float[Tensor, "*s 4"], b: Float[Tensor, "*s 4"]) -> Float[Tensor, "*s 16"]:
    return (a.unsqueeze(-1) * b.unsqueeze(-2)).flatten(-2)


def product(a: Float[Tensor, "*s 4"], b: Float[Tensor, "*s 4"]) -> Float[Tensor, "*s 4"]:
    """Hamilton product ``a ⊗ b``."""
    return _outer(a, b) @ _product_map(a.dtype, a.device)


def matrix(attitude: Float[Tensor, "*s a"]) -> Float[Tensor, "*s d d"]:
    """Body-to-world matrix of a quaternion or heading."""
    if attitude.shape[-1] == 1:
        return geometry.rotation_matrix(attitude)
    flat = _outer(attitude, attitude) @ _matrix_map(attitude.dtype, attitude.device)
    return flat.unflatten(-1, (3, 3))


def matrix_difference(
    attitude: Float[Tensor, "*s a"], reference: Float[Tensor, "*s a"]
) -> Float[Tensor, "*s dd"]:
    """Elements of R(attitude) − R(reference), row by row, without cancellation in float32."""
    if attitude.shape[-1] == 1:
        apart = geometry.rotation_matrix(attitude) - geometry.rotation_matrix(reference)
        return apart.flatten(-2)
    apart = _outer(attitude, attitude) - _outer(reference, reference)
    return apart @ _matrix_map(attitude.dtype, attitude.device)


def rotate(attitude: Float[Tensor, "*s a"], v: Float[Tensor, "*s d"]) -> Float[Tensor, "*s d"]:
    """A body-frame vector in the world frame."""
    return (matrix(attitude) * v.unsqueeze(-2)).sum(-1)


def rotate_by(attitude: Float[Tensor, "*s a"], delta: Float[Tensor, "*s t"]) -> Float[Tensor, "*s a"]:
    """``attitude ⊞ delta``: a right (body-frame) perturbation."""
    if attitude.shape[-1] == 1:
        return geometry.rotate_by(attitude, delta)
    turned = product(attitude, geometry.quaternion_exp(delta))
    return turned / torch.linalg.vector_norm(turned, dim=-1, keepdim=True)


def rotation_between(
    start: Float[Tensor, "*s a"], end: Float[Tensor, "*s a"]
) -> Float[Tensor, "*s t"]:
    """``end ⊟ start``: the body-frame rotation vector that takes ``start`` to ``end``."""
    if start.shape[-1] == 1:
        return geometry.rotation_between(start, end)
    return geometry.quaternion_log(product(geometry.quaternion_conjugate(start), end))
