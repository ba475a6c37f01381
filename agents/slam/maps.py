"""Maps: landmarks anywhere in the arena at first, then where they are first seen; and what others'
maps add to one."""

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from agents.models.process import Process
from coloc_env.motion import Arena


def uniform(
    arena: Arena, count: int, like: Tensor
) -> tuple[Float64[Tensor, "L*d"], Float64[Tensor, "L*d"]]:
    """Means (m) and variances (m²) of uniform positions in the arena, of so many landmarks."""
    low, high = (like.new_tensor(side) for side in (arena.low, arena.high))
    return (0.5 * (low + high)).repeat(count), ((high - low) ** 2 / 12).repeat(count)


def first_seen(
    process: Process,
    x: Float64[Tensor, "B N S"],
    vectors: Float[Tensor, "B N L d"],
    new: Bool[Tensor, "B N L"],
    otherwise: Float64[Tensor, "B G L d"],
) -> Float64[Tensor, "B G L d"]:
    """Where landmarks that are new are: p + R z, on the average over those of a group of UAVs that
    see them; all others as they were (``otherwise``)."""
    shape = otherwise.shape[1], x.shape[1] // otherwise.shape[1]
    rotation = process.rotation(x)
    assert rotation is not None
    place = x[..., None, : process.dim] + vectors.double() @ rotation.mT
    counts = new.unflatten(1, shape).unsqueeze(-1).double()
    times = counts.sum(2)
    total = (place.unflatten(1, shape) * counts).sum(2)
    return torch.where(times > 0, total / times.clamp_min(1.0), otherwise)


def others_maps(
    start: tuple[Float64[Tensor, "M"], Float64[Tensor, "M"]],
    maps: Float64[Tensor, "B N M"],
    precision: Float64[Tensor, "B N M M"],
    heard: Bool[Tensor, "B N N"],
    own: Float64[Tensor, "B N M"],
) -> tuple[Float64[Tensor, "B N M M"], Float64[Tensor, "B N M"]]:
    """What the maps (m, with their information Λ_j) of those who are ``heard`` add to a UAV's own
    information and, about its ``own`` map, vector, their common ``start`` taken off each:
    Λ ← Λ + Σ_j (Λ_j − Λ₀), η ← η + Σ_j (Λ_j m_j − Λ₀ m₀)."""
    middle, variance = start
    vector = (precision @ maps.unsqueeze(-1))[..., 0] - middle / variance
    weight = heard.double()
    added = torch.einsum("bij,bjkl->bikl", weight, precision - (1 / variance).diag())
    eta = torch.einsum("bij,bjk->bik", weight, vector)
    return added, eta - (added @ own.unsqueeze(-1))[..., 0]
