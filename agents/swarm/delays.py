"""Delays of antennas and clocks that calibration has left in ranges: two states a UAV.

A range between i < j is too long by a_i + a_j + s_i − s_j (``coloc_env.sensors.Clock``): antenna
delays a, which are constant, and offsets s of two-way ranging between clocks of different rates,
which change within minutes. They are estimated together with the positions.
"""

import math

import torch
from jaxtyping import Bool, Float64
from tensordict import TensorClass
from torch import Tensor

from agents.tensorclasses import build
from coloc_env.sensors import Clock

_MIN_VARIANCE = 1e-9  # m²: of a delay that is believed to be exact


class Delays(TensorClass):
    """``delay``: each UAV's a and s (m); ``cross``: rows of the covariance of positions with all
    delays (m²); ``common``: rows of that of delays with each other (m²); batch (B, N). L = 2 N, or
    0 where they are not estimated."""

    delay: Float64[Tensor, "B N 2"]
    cross: Float64[Tensor, "B N d L"]
    common: Float64[Tensor, "B N 2 L"]


def initial(like: Float64[Tensor, "B N d"], clock: Clock | None) -> Delays:
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


def predict(
    delays: Delays,
    factor: Float64[Tensor, "B N"],
    fixed: Bool[Tensor, "B N"],
    dt: Float64[Tensor, "B N"],
    clock: Clock,
) -> Delays:
    """After a step of ``dt`` s. Covariances with positions shrink by their ``factor`` (to 0 for
    fixed UAVs). s, a sine of unknown phase, is modelled as a Gauss–Markov process whose time
    constant is a radian of the sine."""
    n, variance = factor.shape[1], _variance(clock, factor)
    phi = remaining(dt, clock)
    every = phi.flatten(1)
    common = phi.unsqueeze(-1) * every[:, None, None] * delays.common
    common.flatten(1, 2).diagonal(dim1=-2, dim2=-1).add_(variance.repeat(n) * (1 - every.square()))
    factor = factor.masked_fill(fixed, 0.0)[..., None, None]
    return delays.replace(
        delay=phi * delays.delay, cross=factor * every[:, None, None] * delays.cross, common=common
    )


def remaining(dt: Float64[Tensor, "B N"], clock: Clock) -> Float64[Tensor, "B N 2"]:
    """What is left of a and s after ``dt`` s, as factors."""
    return torch.stack((torch.ones_like(dt), torch.exp(-dt * (2 * math.pi / clock.period))), -1)


def incidence(like: Float64[Tensor, "B N *s"]) -> Float64[Tensor, "2 N N"]:
    """Derivatives e_ij of the range i–j by i's delays: 1 by a_i; 1 by s_i, −1 where j < i."""
    first = torch.ones(like.shape[1], like.shape[1], dtype=like.dtype, device=like.device).triu()
    return torch.stack((torch.ones_like(first), 2 * first - 1))


def offsets(delay: Float64[Tensor, "B N 2"]) -> Float64[Tensor, "B N N"]:
    """Offsets of ranges (m): a_i + a_j + s_i − s_j for i < j."""
    own = torch.einsum("rij,bir->bij", incidence(delay), delay)
    return own + own.mT


def information(
    weight: Float64[Tensor, "B N N"], unit: Float64[Tensor, "B N N d"]
) -> tuple[Float64[Tensor, "B N*d 2*N"], Float64[Tensor, "B 2*N 2*N"]]:
    """Information Jᵀ W J of ranges with these weights (1/m²), along unit vectors u from j to i: its
    blocks of positions with delays, and of delays; J = (u, −u, e_ij, e_ji)."""
    e = incidence(weight)
    cross = torch.einsum("bij,bijd,rji->bidjr", weight, unit, e)
    common = torch.einsum("bij,rij,qji->birjq", weight, e, e)
    own = torch.einsum("bij,bijd,rij->bdri", weight, unit, e)
    here = torch.einsum("bij,rij,qij->brqi", weight, e, e)
    cross.diagonal(dim1=1, dim2=3).add_(own)
    common.diagonal(dim1=1, dim2=3).add_(here)
    return cross.flatten(3).flatten(1, 2), common.flatten(3).flatten(1, 2)


def offset_variance(delays: Delays) -> Float64[Tensor, "B N N"]:
    """Variance (m²) of the offset of each range."""
    common = delays.common.unflatten(-1, (-1, 2))  # [B, N, 2, N, 2]
    e = incidence(common)
    here = torch.einsum("rij,qij,brqi->bij", e, e, common.diagonal(dim1=1, dim2=3))
    between = torch.einsum("rij,qji,birjq->bij", e, e, common)
    return (here + here.mT + 2 * between).clamp_min(0.0)


def joint_covariance(joint: Float64[Tensor, "B N d K"], delays: Delays) -> Float64[Tensor, "B M M"]:
    """The joint covariance of positions and, where they are estimated, delays (m²)."""
    if not delays.common.shape[-1]:
        return joint.flatten(1, 2)
    positions, cross, common = (each.flatten(1, 2) for each in (joint, delays.cross, delays.common))
    rows = torch.cat((positions, cross), -1), torch.cat((cross.mT, common), -1)
    return torch.cat(rows, -2)


def split(
    covariance: Float64[Tensor, "B M M"], delay: Float64[Tensor, "B N 2"], d: int
) -> tuple[Float64[Tensor, "B N d K"], Delays]:
    """The joint covariance of positions, and the delays with theirs; the reverse of
    ``joint_covariance``."""
    size = delay.shape[1] * d
    width = covariance.shape[-1] - size
    positions = covariance[:, :size].unflatten(1, (-1, d))
    common = (
        covariance[:, size:, size:].unflatten(1, (-1, 2)) if width else delay.unsqueeze(-1)[..., :0]
    )
    delays = build(
        Delays,
        delay.shape[:2],
        delay=delay,
        cross=positions[..., size:].contiguous(),
        common=common.contiguous(),
    )
    return positions[..., :size].contiguous(), delays


def _variance(clock: Clock, like: Tensor) -> Float64[Tensor, "2"]:
    return like.new_tensor((clock.offset**2, 0.5 * clock.skew**2)).clamp_min(_MIN_VARIANCE)
