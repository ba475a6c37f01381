"""Marginal covariances of UAVs, and the joint covariance that has given ones."""

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.models.update import posterior

_EXACT = 1e-12  # m²: keeps the covariance of an exact position regular


def range_update(
    marginal: Float64[Tensor, "B N d d"],
    position: Float64[Tensor, "B M d"],
    weight: Float64[Tensor, "B M M"],
    variance: Float64[Tensor, "B M"],
) -> Float64[Tensor, "B N d d"]:
    """Marginal covariances (m²) of the first N UAVs after ranges with these weights (1/m²) to
    others with this ``variance`` v (m² per axis): P⁻¹ ← P⁻¹ + Σ_j W_ij/(1 + W_ij v_j) u uᵀ."""
    n = marginal.shape[1]
    difference = position[:, :n].unsqueeze(2) - position.unsqueeze(1)
    length = torch.linalg.vector_norm(difference, dim=-1, keepdim=True).clamp_min(1e-9)
    unit = difference / length
    effective = weight[:, :n] / (1 + weight[:, :n] * variance.unsqueeze(1))
    information = (effective.unsqueeze(-1) * unit).mT @ unit
    _, after = posterior(marginal, information, torch.zeros_like(marginal[..., 0]))
    return after


def with_marginals(
    joint: Float64[Tensor, "B N e N*e"],
    before: Float64[Tensor, "B N e e"],
    after: Float64[Tensor, "B N e e"],
) -> Float64[Tensor, "B N e N*e"]:
    """The joint covariance with marginals ``after`` in place of ``before``: P ← S P Sᵀ + A.

    In coordinates in which ``before`` is the identity and ``after`` diag(m), S = diag(min(1, m))
    and A = diag(m) − S²: where m ≥ 1, independent noise was added; where m < 1, the UAV measured
    something itself, and its covariance with others shrinks by m (as by I − K H).
    """
    e = joint.shape[2]
    root = torch.linalg.cholesky_ex(regular(before)).L
    half = torch.linalg.solve_triangular(root, after, upper=False)
    ratio = torch.linalg.solve_triangular(root, half.mT, upper=False)
    sound = ratio.isfinite().all(-1, keepdim=True).all(-2, keepdim=True)
    m, turn = torch.linalg.eigh(torch.where(sound, 0.5 * (ratio + ratio.mT), _eye(ratio)))
    m, axes = m.clamp_min(0).unsqueeze(-2), root @ turn
    less = m.clamp_max(1.0)
    scale = torch.linalg.solve_triangular(root, axes * less @ turn.mT, upper=False, left=False)
    blocks = joint.unflatten(-1, (-1, e)).transpose(2, 3)  # [B, i, j, e, e]
    blocks = scale.unsqueeze(2) @ blocks @ scale.mT.unsqueeze(1)
    blocks.diagonal(dim1=1, dim2=2).add_(((axes * (m - less**2)) @ axes.mT).movedim(1, -1))
    return blocks.transpose(2, 3).flatten(-2)


def block_diagonal(marginals: Float64[Tensor, "B N e e"]) -> Float64[Tensor, "B N e N*e"]:
    """The joint covariance of independent UAVs, from their marginals (m²)."""
    return torch.diag_embed(marginals.movedim(1, -1)).permute(0, 3, 1, 4, 2).flatten(-2)


def regular(covariance: Float64[Tensor, "B N e e"]) -> Float64[Tensor, "B N e e"]:
    """A covariance (m²) that can be inverted, if a position is exact as well."""
    return covariance + _EXACT * _eye(covariance)


def _eye(like: Float64[Tensor, "B N e e"]) -> Float64[Tensor, "e e"]:
    return torch.eye(like.shape[-1], dtype=like.dtype, device=like.device)
