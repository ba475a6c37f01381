"""How far off positions found from ranges can be, by what UAVs with fixes tell through the network.

Each UAV's information comes along its links, as far as the UAV at the other end is informed itself,
beginning at those with fixes: a part of the network without any informs nobody. What neighbours
know by dead reckoning is not passed on, since it would come back as if it were news.
"""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.swarm.links import lengths, own_information

_HOPS = 6  # links that information goes along
_NOTHING = 1e-9  # m⁻²: information where there is none
_LOST = 1e6  # m²: who is that unsure tells nobody anything


def told(
    y: Float64[Tensor, "B N d"],
    distance: Float64[Tensor, "B N N"],
    weight: Float64[Tensor, "B N N"],
    fixed: Bool[Tensor, "B N"],
    variance: Float64[Tensor, "B N"],
    std: float,
) -> Float64[Tensor, "B N d d"]:
    """Information (1/m²) on each position from its ranges: Σ_j u uᵀ / (s² + v_j), with u the unit
    vector along the link, v_j what its other end is unsure of, and s² what the UAV's residuals show
    of ranges with these weights, n Σ W² r² / (Σ W)², ``std``² at least. Links shorter than ``std``
    point nowhere and count less. Who is ``fixed`` has v = ``variance`` and is told nothing."""
    linked, d = weight > 0, y.shape[-1]
    length = lengths(y)
    count, total = linked.sum(-1), weight.sum(-1)
    seen = count * (weight * (distance - length)).square().sum(-1) / total.square()
    noise = torch.where(total > 0, seen, 0.0).clamp_min(std**2).unsqueeze(-1)
    near = length.clamp_min(std)
    y = y - y.mean(1, keepdim=True)
    eye = torch.eye(d, dtype=y.dtype, device=y.device)
    information = y.new_zeros(*y.shape, d)
    unsure = torch.where(fixed, variance, torch.inf)
    for _ in range(_HOPS):
        information = own_information(y, linked / (noise + unsure.unsqueeze(-2)), near)
        inverse = torch.linalg.inv_ex(information + _NOTHING * eye).inverse
        own = inverse.diagonal(dim1=-2, dim2=-1).mean(-1)
        unsure = torch.where(fixed, variance, own.masked_fill(own > _LOST, torch.inf))
    return information.masked_fill(fixed[..., None, None], 0.0)


def spread(
    information: Float64[Tensor, "B N d d"],
    trust: Float64[Tensor, "B N"],
    variance: Float64[Tensor, "B N"],
    fixed: Bool[Tensor, "B N"],
) -> Float64[Tensor, "B N"]:
    """Variance (m² per axis) of positions that were found from ``information`` J and from a start
    that counted for ``trust`` λ (1/m²) and has ``variance`` P in truth, (J + λI)⁻¹ (J + λ²P I)
    (J + λI)⁻¹. Where nothing is told, or who is ``fixed``, it is P.

    k steps y ← y + ω D⁻¹ (…) that begin there count it for D / (ω k), as early stopping does.
    """
    eye = torch.eye(information.shape[-1], dtype=information.dtype, device=information.device)
    held = torch.where(fixed | (trust <= 0), 1 / variance, trust)[..., None, None]
    inverse = torch.linalg.inv_ex(information + held * eye).inverse
    both = inverse @ (information + held.square() * variance[..., None, None] * eye) @ inverse
    return both.diagonal(dim1=-2, dim2=-1).mean(-1)
