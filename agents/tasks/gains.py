"""What a range would be worth: how much it takes off the variance of positions, predicted."""

import torch
from jaxtyping import Float
from torch import Tensor

from agents.tasks.task import NOISE

_OMEGAS = (0.95, 0.85, 0.7, 0.5)


def directions(
    own: Float[Tensor, "B n d"], other: Float[Tensor, "B m d"]
) -> tuple[Float[Tensor, "B n m d"], Float[Tensor, "B n m"], Float[Tensor, "B n m"]]:
    """Unit vectors from others, distances (m) and variances of ranges (m²)."""
    apart = own.unsqueeze(2) - other.unsqueeze(1)
    distance = (apart * apart).sum(-1).sqrt()
    variance = (NOISE.std + NOISE.per_metre * distance) ** 2
    return apart / distance.unsqueeze(-1).clamp_min(1e-6), distance, variance


def range_gains(
    position: Float[Tensor, "B N d"], joint: Float[Tensor, "B N N d d"]
) -> Float[Tensor, "B N N N"]:
    """What a range between i and j takes off tr P_k, in m², as [B, i, j, k]:

    tr ΔP_k = ‖(P_ki − P_kj) u‖² / S,  S = uᵀ (P_ii + P_jj − P_ij − P_ji) u + R.
    """
    unit, _, variance = directions(position, position)
    # columns[b, i, j, k] = (P_ki − P_kj) u_ij
    to_i = torch.einsum("bkide,bije->bijkd", joint, unit)
    to_j = torch.einsum("bkjde,bije->bijkd", joint, unit)
    columns = to_i - to_j
    n = position.shape[1]
    i = torch.arange(n, device=position.device)
    at_i = columns[:, i[:, None], i, i[:, None]]
    at_j = columns[:, i[:, None], i, i]
    s = (unit * (at_i - at_j)).sum(-1) + variance
    return (columns * columns).sum(-1) / s.unsqueeze(-1)


def anchor_gains(
    position: Float[Tensor, "B N d"],
    joint: Float[Tensor, "B N N d d"],
    anchors: Float[Tensor, "A d"],
) -> Float[Tensor, "B N A N"]:
    """What a range between i and an anchor takes off tr P_k, in m², as [B, i, a, k]."""
    unit, _, variance = directions(position, anchors.expand(len(position), -1, -1))
    columns = torch.einsum("bkide,biae->biakd", joint, unit)
    n = position.shape[1]
    i = torch.arange(n, device=position.device)
    own = columns[:, i, :, i].movedim(0, 1)  # [B, i, a, d]
    s = (unit * own).sum(-1) + variance
    return (columns * columns).sum(-1) / s.unsqueeze(-1)


def intersection_gains(
    position: Float[Tensor, "B N d"], own: Float[Tensor, "B N d d"]
) -> Float[Tensor, "B N N"]:
    """What listener i takes off tr P_i, in m², by covariance intersection with speaker j [B, i, j]:

    tr P_i − min_ω { tr P_i / ω − ‖P_i u‖² / ω² / (uᵀP_i u / ω + R + uᵀP_j u / (1 − ω)) }.
    """
    unit, _, variance = directions(position, position)
    mine = torch.einsum("bide,bije->bijd", own, unit)
    theirs = torch.einsum("bjde,bije->bijd", own, unit)
    a, b = (unit * mine).sum(-1), (unit * theirs).sum(-1)
    trace = own.diagonal(dim1=-2, dim2=-1).sum(-1).unsqueeze(-1)
    squared = (mine * mine).sum(-1)
    best = torch.zeros_like(a)
    for omega in _OMEGAS:
        s = a / omega + variance + b / (1 - omega)
        best = torch.maximum(best, trace - trace / omega + squared / omega**2 / s)
    return best


def log_gain(gain: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """Gains of 10⁻³ … 10 m² as −1 … 1."""
    return (gain.clamp_min(1e-9).log10() + 1.0) / 2.0


def rank(value: Float[Tensor, "B n"]) -> Float[Tensor, "B n"]:
    """−1 for the smallest of the team, 1 for the largest."""
    n = value.shape[-1]
    return (
        2 * (value.unsqueeze(-1) > value.unsqueeze(-2)).to(value.dtype).sum(-1) / max(n - 1, 1) - 1
    )
