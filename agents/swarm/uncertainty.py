"""Variances of positions by ranges, from the information that anchors spread through the network.

Information comes along links, as far as the UAV at the other end is informed itself, starting at
the anchors: a part of the network without anchors has none. Neighbours' dead reckoning is not
passed on, since it would come back and be counted twice.
"""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.swarm.links import lengths, own_information

_HOPS = 6  # links that information goes along
_MIN_INFORMATION = 1e-9  # m⁻²: keeps matrices regular
_MAX_VARIANCE = 1e6  # m²: beyond, a UAV informs no other


def anchor_information(
    y: Float64[Tensor, "B N d"],
    distance: Float64[Tensor, "B N N"],
    weight: Float64[Tensor, "B N N"],
    fixed: Bool[Tensor, "B N"],
    variance: Float64[Tensor, "B N"],
    std: float,
) -> Float64[Tensor, "B N d d"]:
    """Information (1/m²) on each position from its ranges: Σ_j u uᵀ / (s² + v_j), u the unit
    vector along the link, v_j the variance of its other end, and s² the variance of ranges by the
    UAV's residuals, n Σ W² r² / (Σ W)², at least ``std``². Links shorter than ``std`` have no
    direction and count less. Fixed UAVs have v = ``variance`` and no information of their own."""
    linked, d = weight > 0, y.shape[-1]
    length = lengths(y)
    count, total = linked.sum(-1), weight.sum(-1)
    sample = count * (weight * (distance - length)).square().sum(-1) / total.square()
    noise = torch.where(total > 0, sample, 0.0).clamp_min(std**2).unsqueeze(-1)
    length = length.clamp_min(std)
    y = y - y.mean(1, keepdim=True)
    eye = torch.eye(d, dtype=y.dtype, device=y.device)
    information = y.new_zeros(*y.shape, d)
    v = torch.where(fixed, variance, torch.inf)
    for _ in range(_HOPS):
        weight = linked / (noise + v.unsqueeze(-2))
        information = own_information(y, weight / length.square())
        inverse = torch.linalg.inv_ex(information + _MIN_INFORMATION * eye).inverse
        own = inverse.diagonal(dim1=-2, dim2=-1).mean(-1)
        v = torch.where(fixed, variance, own.masked_fill(own > _MAX_VARIANCE, torch.inf))
    return information.masked_fill(fixed[..., None, None], 0.0)


def position_variance(
    information: Float64[Tensor, "B N d d"],
    precision: Float64[Tensor, "B N"],
    variance: Float64[Tensor, "B N"],
    fixed: Bool[Tensor, "B N"],
) -> Float64[Tensor, "B N"]:
    """Variance (m² per axis) of positions from ``information`` J and a prior that was weighted by
    ``precision`` λ (1/m²) and has ``variance`` P in truth: (J + λI)⁻¹ (J + λ²P I) (J + λI)⁻¹. It is
    P without information, and for fixed UAVs.

    k steps y ← y + ω D⁻¹ (…) from the prior weight it by D / (ω k), as early stopping does.
    """
    eye = torch.eye(information.shape[-1], dtype=information.dtype, device=information.device)
    lam = torch.where(fixed | (precision <= 0), 1 / variance, precision)[..., None, None]
    inverse = torch.linalg.inv_ex(information + lam * eye).inverse
    both = inverse @ (information + lam.square() * variance[..., None, None] * eye) @ inverse
    return both.diagonal(dim1=-2, dim2=-1).mean(-1)
