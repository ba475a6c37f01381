"""Condensed graphs: what a UAV's own sensors say of its track, and ranges to such tracks.

DDF-SAM (Cunningham, Paluri & Dellaert 2010): a UAV sends the joint marginal of its positions in the
window from its *own* factors alone. A receiver ties its own window to that by the ranges it
measured; what comes of it is never sent on, so nothing counts twice.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.models.measurements import Block
from agents.robust import SoftName, widened
from coloc_env.observation import Observation


@dataclass(frozen=True)
class Tracks:
    """Positions in the W steps of a window (m) and their joint covariance (m²), of the UAVs in each
    UAV's slots; ``known``: which of them it has. Where tracks depend on L numbers that all share (a
    map), the covariance is that given them, and ``slope`` the derivative of positions by them."""

    position: Float64[Tensor, "B N S W d"]
    covariance: Float64[Tensor, "B N S W W d d"]
    known: Bool[Tensor, "B N S W"]
    slope: Float64[Tensor, "B N S W d L"]


@dataclass(frozen=True)
class Common:
    """What a UAV's own window (``slope``) and the tracks of others depend on: L numbers of a
    ``covariance``."""

    slope: Float64[Tensor, "B N W E L"]
    covariance: Float64[Tensor, "B N L L"]


def condensed(
    position: Float64[Tensor, "B N W d"], joint: Float64[Tensor, "B N W W E E"]
) -> Float64[Tensor, "B N L"]:
    """The message: positions, and their joint covariance from that of the states' errors."""
    d = position.shape[-1]
    return torch.cat((position.flatten(-2), joint[..., :d, :d].flatten(-4)), -1)


def arrived(
    sent: Float64[Tensor, "B N M"],
    observation: Observation,
    size: int,
    dim: int,
    age: int,
    shared: int = 0,
) -> Tracks:
    """The tracks of ``size`` steps that have arrived, moved to the receiver's window: they end
    ``age`` steps before it. They depend on so many ``shared`` numbers."""
    if "neighbours" in observation:
        world = torch.arange(len(sent), device=sent.device)[:, None, None]
        theirs = sent[world, observation["neighbours"].long()]
    else:
        theirs = sent.unsqueeze(1).expand(-1, sent.shape[1], -1, -1)
    heard = (observation["message_mask"] > 0) & theirs.isfinite().all(-1)
    theirs = torch.where(heard.unsqueeze(-1), theirs, 0.0)
    each = size * dim
    position, covariance, slope = theirs.split((each, each**2, each * shared), -1)
    age = min(age, size)
    position = position.unflatten(-1, (size, dim)).roll(-age, -2)
    covariance = covariance.unflatten(-1, (size, size, dim, dim)).roll((-age, -age), (-4, -3))
    slope = slope.unflatten(-1, (size, dim, shared)).roll(-age, -3)
    there = torch.arange(size, device=sent.device) < size - age
    return Tracks(position, covariance, heard.unsqueeze(-1) & there, slope)


@dataclass(frozen=True)
class Tied:
    """Corrections of a window's states by ranges to condensed tracks: of all (``delta``), and the
    newest one's covariance."""

    delta: Float64[Tensor, "B N W E"]
    covariance: Float64[Tensor, "B N E E"]


def tie(
    joint: Float64[Tensor, "B N W W E E"],
    tracks: Tracks,
    linearize: Callable[[Float64[Tensor, "B N W E"]], Sequence[Block]],
    robust: SoftName,
    iterations: int = 2,
    common: Common | None = None,
) -> Tied:
    """MAP of a window, with the joint covariance Σ of its own graph, and of the condensed tracks,
    tied by all their ranges r = z − h, J = ∂h/∂δ and G = ∂h/∂p_j.

    The neighbours' positions are eliminated: what they do not know of themselves makes ranges to
    one neighbour in several steps have correlated noise,
    R = σ² I + G Σ_j Gᵀ, so that δ = Σ Jᵀ (J Σ Jᵀ + R)⁻¹ (r + J δ). What both depend on (``common``,
    of covariance M) moves a range by K = J B_i + G B_j: K M Kᵀ comes to the innovation's
    covariance, B_i M Kᵀ to that between states and ranges.
    """
    b, n, w, _, e, _ = joint.shape
    slots = tracks.known.shape[2]
    own = torch.eye(slots, dtype=torch.bool, device=joint.device)[:, None, None, :, None]
    delta = joint.new_zeros(b, n, w, e)
    last = joint[..., -1, -1, :, :]
    if common is not None:
        newest = common.slope[:, :, -1]
        last = last + newest @ common.covariance @ newest.mT
    covariance = last
    for _ in range(iterations):
        parts = [_by_slot(block, slots, robust) for block in linearize(delta)]
        j, g, r, variance = (torch.cat(part, 4) for part in zip(*parts, strict=True))
        spread = torch.einsum("bnuwef,bnwsmf->bnuewsm", joint, j)  # Σ Jᵀ
        noise = torch.einsum("bnusmd,bnsuwdf,bnwspf->bnusmwp", g, tracks.covariance, g)
        innovation = torch.einsum("bnusme,bnuewtp->bnusmwtp", j, spread)
        innovation = innovation + torch.where(own, noise.unsqueeze(-2), 0.0)
        if common is not None:
            k = torch.einsum("bnwsme,bnwel->bnwsml", j, common.slope)
            k += torch.einsum("bnwsmd,bnswdl->bnwsml", g, tracks.slope)
            moved = torch.einsum("bnwsml,bnlk->bnwsmk", k, common.covariance)
            spread += torch.einsum("bnuek,bnwsmk->bnuewsm", common.slope, moved)
            innovation += torch.einsum("bnusmk,bnwtpk->bnusmwtp", k, moved)
        total = innovation.flatten(5).flatten(2, 4) + torch.diag_embed(variance.flatten(2))
        ahead = r + (j @ delta[:, :, :, None, :, None])[..., 0]
        spread = spread.flatten(4).flatten(2, 3)  # [B, N, W·E, W·S·m]
        gain = torch.linalg.solve(total, spread.mT).mT
        delta = (gain @ ahead.flatten(2).unsqueeze(-1)).view(b, n, w, e)
        covariance = last - gain[..., -e:, :] @ spread[..., -e:, :].mT
    return Tied(delta, 0.5 * (covariance + covariance.mT))


def _by_slot(
    block: Block, slots: int, robust: SoftName
) -> tuple[
    Float64[Tensor, "B N W S m E"],
    Float64[Tensor, "B N W S m d"],
    Float64[Tensor, "B N W S m"],
    Float64[Tensor, "B N W S m"],
]:
    """J, G, r and the variances of a block whose measurements come as (…, slot, ``per_slot``); what
    was not measured has a row of zeros and variance 1."""
    assert block.partner is not None
    variance = widened(robust, block)
    there = block.mask.unsqueeze(-1)

    def arranged(values: Tensor, otherwise: float) -> Tensor:
        kept = torch.where(there if values.dim() == there.dim() else there[..., None], values,
                           otherwise)  # fmt: skip
        apart = kept.unflatten(3, (-1, slots, block.per_slot)).movedim(4, 3)
        return apart.flatten(4, 6)

    parts = (block.jacobian, block.partner, block.residual)
    j, g, r = (arranged(part, 0.0) for part in parts)
    return j, g, r, arranged(variance, 1.0)
