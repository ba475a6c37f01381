"""What UAVs' clocks and antennas add to ranges, which calibration has left: two numbers a UAV.

A range between i < j is too long by a_i + a_j + s_i − s_j (``coloc_env.sensors.Clock``): antenna
delays a, which are constant, and what clocks that run at different rates make of two-way ranging,
s, which changes within minutes. They are unknowns beside the positions, with a covariance of their
own and one with the positions.
"""

import math

import torch
from jaxtyping import Bool, Float64
from tensordict import TensorClass
from torch import Tensor

from agents.tensorclasses import build
from coloc_env.sensors import Clock

_LEAST = 1e-9  # m²: variance of what is said to be known


class Delays(TensorClass):
    """Each UAV's ``a`` and ``s`` in metres (``delay``), their covariance with all positions
    (``cross``, m²) and with each other (``common``, m²), batch (B, N); L = 2 N, or 0 where they are
    not estimated."""

    delay: Float64[Tensor, "B N 2"]
    cross: Float64[Tensor, "B N d L"]
    common: Float64[Tensor, "B N 2 L"]


def begun(like: Float64[Tensor, "B N d"], clock: Clock | None) -> Delays:
    """Before any range; without a clock they are not estimated."""
    (b, n, d), width = like.shape, 0 if clock is None else 2 * like.shape[1]
    common = like.new_zeros(b, 2 * n, width)
    if clock is not None:
        common.diagonal(dim1=-2, dim2=-1).copy_(_variance(clock, like).repeat(n))
    return build(
        Delays,
        like.shape[:2],
        delay=like.new_zeros(b, n, 2),
        cross=like.new_zeros(b, n, d, width),
        common=common.unflatten(1, (n, 2)),
    )


def carried(
    delays: Delays,
    kept: Float64[Tensor, "B N"],
    fixed: Bool[Tensor, "B N"],
    dt: Float64[Tensor, "B N"],
    clock: Clock,
) -> Delays:
    """After a step of ``dt`` s that left so much of what was ``kept`` of positions (of who is fixed
    nothing is common with anybody's). A sine of unknown phase is forgotten after a radian: s is
    taken for a Gauss–Markov process of that time constant."""
    n, variance = kept.shape[1], _variance(clock, kept)
    stays = torch.ones_like(dt).unsqueeze(-1).repeat(1, 1, 2)
    stays[..., 1] = torch.exp(-dt * (2 * math.pi / clock.period))
    every = stays.flatten(1)
    common = stays.unsqueeze(-1) * every[:, None, None] * delays.common
    common.flatten(1, 2).diagonal(dim1=-2, dim2=-1).add_(variance.repeat(n) * (1 - every.square()))
    kept = kept.masked_fill(fixed, 0.0)[..., None, None]
    return delays.replace(
        delay=stays * delays.delay, cross=kept * every[:, None, None] * delays.cross, common=common
    )


def ends(like: Float64[Tensor, "B N *s"]) -> Float64[Tensor, "2 N N"]:
    """What of i's a and s is added to its range with j: a_i, and s_i or, where j < i, −s_i."""
    first = torch.ones(like.shape[1], like.shape[1], dtype=like.dtype, device=like.device).triu()
    return torch.stack((torch.ones_like(first), 2 * first - 1))


def added(delay: Float64[Tensor, "B N 2"]) -> Float64[Tensor, "B N N"]:
    """What is added to ranges (m)."""
    own = torch.einsum("rij,bir->bij", ends(delay), delay)
    return own + own.mT


def information(
    weight: Float64[Tensor, "B N N"], unit: Float64[Tensor, "B N N d"]
) -> tuple[Float64[Tensor, "B N*d 2*N"], Float64[Tensor, "B 2*N 2*N"]]:
    """What ranges with these weights (1/m²), along unit vectors from j to i, tell of positions and
    delays in common, and of delays: J = (u, −u, e_ij, e_ji)."""
    e = ends(weight)
    cross = torch.einsum("bij,bijd,rji->bidjr", weight, unit, e)
    common = torch.einsum("bij,rij,qji->birjq", weight, e, e)
    own = torch.einsum("bij,bijd,rij->bdri", weight, unit, e)
    here = torch.einsum("bij,rij,qij->brqi", weight, e, e)
    cross.diagonal(dim1=1, dim2=3).add_(own)
    common.diagonal(dim1=1, dim2=3).add_(here)
    return cross.flatten(3).flatten(1, 2), common.flatten(3).flatten(1, 2)


def unsure(delays: Delays) -> Float64[Tensor, "B N N"]:
    """Variance (m²) of what is added to a range."""
    common = delays.common.unflatten(-1, (-1, 2))  # [B, N, 2, N, 2]
    e = ends(common)
    here = torch.einsum("rij,qij,brqi->bij", e, e, common.diagonal(dim1=1, dim2=3))
    between = torch.einsum("rij,qji,birjq->bij", e, e, common)
    return (here + here.mT + 2 * between).clamp_min(0.0)


def whole(joint: Float64[Tensor, "B N d K"], delays: Delays) -> Float64[Tensor, "B M M"]:
    """The covariance of positions and of delays, if there are any."""
    if not delays.common.shape[-1]:
        return joint.flatten(1, 2)
    positions, cross, common = (each.flatten(1, 2) for each in (joint, delays.cross, delays.common))
    rows = torch.cat((positions, cross), -1), torch.cat((cross.mT, common), -1)
    return torch.cat(rows, -2)


def parts(
    whole: Float64[Tensor, "B M M"], delay: Float64[Tensor, "B N 2"], d: int
) -> tuple[Float64[Tensor, "B N d K"], Delays]:
    """The covariance of positions, and the delays with theirs."""
    size = delay.shape[1] * d
    width = whole.shape[-1] - size
    positions = whole[:, :size].unflatten(1, (-1, d))
    common = whole[:, size:, size:].unflatten(1, (-1, 2)) if width else delay.unsqueeze(-1)[..., :0]
    known = build(
        Delays,
        delay.shape[:2],
        delay=delay,
        cross=positions[..., size:].contiguous(),
        common=common.contiguous(),
    )
    return positions[..., :size].contiguous(), known


def _variance(clock: Clock, like: Tensor) -> Float64[Tensor, "2"]:
    return like.new_tensor((clock.offset**2, 0.5 * clock.skew**2)).clamp_min(_LEAST)
