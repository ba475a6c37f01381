"""Log-likelihoods of particles, up to a constant per UAV."""

from collections.abc import Sequence

import torch
from jaxtyping import Float32
from torch import Tensor

from agents.models.measurements import (
    AnchorRanges,
    Block,
    LandmarkVectors,
    Measurement,
    Neighbours,
    UavRanges,
    per_state,
)
from agents.models.process import Process
from agents.particle.landmark_densities import (
    any_landmark_log_likelihood,
    each_landmark_log_likelihood,
)
from agents.robust import Trust
from agents.robust.heavy_tails import LogDensity
from coloc_env.observation import Observation


def landmark_log_likelihood(
    model: LandmarkVectors,
    process: Process,
    particles: Float32[Tensor, "B N M S"],
    centre: Float32[Tensor, "B N S"],
    observation: Observation,
    trust: Trust,
) -> Float32[Tensor, "B N M"]:
    """−Σ w‖z − Rᵀ(L − p)‖² / 2σ² over landmarks, from sums over landmarks made once per UAV:

    Σ w‖z − Rᵀ(L − p)‖² = Σw ‖p‖² − 2 p·(ΣwL − R Σwz) − 2 tr(R Σ w z Lᵀ) + const,

    so a particle costs O(1). Exact; p and L are taken about the centre's position and R about the
    centre's rotation (R = R̄ + ΔR), which keeps float32 from cancelling.
    """
    d = process.dim
    seen, there = model.read(observation, d)
    weight = there.to(seen.dtype)
    if trust.weight is not None:
        weight = weight * trust.weight.to(weight.dtype)
    weight = weight.unsqueeze(-1)
    z = seen * weight
    points = observation["landmark_map"].unflatten(-1, (-1, d)) - centre[..., None, :d]
    at = process.rotation(centre)
    if at is None:
        raise ValueError("landmark vectors are in the body frame: the motion model has no attitude")
    count, sum_z = weight.sum((-2, -1)), z.sum(-2)
    p = particles[..., :d] - centre[..., None, :d]
    rotation = process.rotation(particles)
    assert rotation is not None
    turn = rotation.flatten(-2) - at.flatten(-2).unsqueeze(-2)
    # ΔR enters through ΔR Σz and tr(ΔR Σ z Lᵀ): one product with a [d², d + 1] matrix.
    by_row = torch.zeros(*sum_z.shape[:-1], d, d, d + 1, dtype=torch.float32, device=z.device)
    for row in range(d):
        by_row[..., row, :, row] = sum_z
    by_row[..., d] = points.mT @ z
    turned = (by_row.flatten(-3, -2).mT @ turn.mT).mT
    fixed = (points * weight).sum(-2) - (at @ sum_z.unsqueeze(-1))[..., 0]
    along = p * (count[..., None, None] * p + 2 * (turned[..., :d] - fixed.unsqueeze(-2)))
    return (sum(along.unbind(-1)) - 2 * turned[..., d]) * (-0.5 / model.std**2)


def range_log_likelihood(
    block: Block,
    ranges: Float32[Tensor, "B N S"],
    particles: Float32[Tensor, "B N M d"],
    points: Float32[Tensor, "B N S d"],
    trust: Trust,
    tails: LogDensity | None = None,
) -> Float32[Tensor, "B N M"]:
    """−Σ w (r − ‖p − point‖)² / 2s² with the variances s² of the ``block`` made at the centre;
    ``tails``: another density than the Gaussian."""
    squared: Tensor | None = None
    for own, theirs in zip(particles.unbind(-1), points.unbind(-1), strict=True):
        apart = own.unsqueeze(-2) - theirs.unsqueeze(-1)  # [B, N, S, M]
        squared = apart.mul_(apart) if squared is None else squared.addcmul_(apart, apart)
    assert squared is not None
    if trust.shift is not None:
        ranges = ranges - trust.shift.to(ranges.dtype)
    residual = squared.sqrt_().sub_(ranges.unsqueeze(-1))
    if tails is not None:
        each = tails(residual.square_() / block.total_variance.to(ranges.dtype), 1)
        counted = block.mask if trust.weight is None else block.mask * trust.weight
        return (each * counted.unsqueeze(-1)).sum(-2)
    weight = trust.information(block)[..., 0].to(ranges.dtype)
    return (weight.unsqueeze(-2) @ residual.square_())[..., 0, :] * -0.5


def log_likelihood(
    models: Sequence[Measurement],
    process: Process,
    particles: Float32[Tensor, "B N M S"],
    centre: Float32[Tensor, "B N S"],
    observation: Observation,
    neighbours: Neighbours,
    trusts: Sequence[Trust],
    tails: LogDensity | None = None,
    volume: float | None = None,
) -> Float32[Tensor, "B N M"]:
    """Sum over all sensors' measurements, each weighted by ``trusts``; what a neighbour's
    uncertainty adds to a range's variance is taken at the centre. ``tails``: another density than
    the Gaussian. With a ``volume`` (m³) in which clutter lies, landmarks come without names."""
    total = torch.zeros_like(particles[..., 0])
    d = process.dim
    near = Neighbours(
        neighbours.position.to(total.dtype), neighbours.variance.to(total.dtype), neighbours.known
    )
    for model, trust in zip(models, trusts, strict=True):
        if isinstance(model, LandmarkVectors) and volume is not None:
            total = total + any_landmark_log_likelihood(
                model, process, particles, centre, observation, volume, tails
            )
            continue
        if isinstance(model, LandmarkVectors) and tails is not None:
            total = total + each_landmark_log_likelihood(
                model, process, particles, observation, trust.weight, tails
            )
            continue
        if isinstance(model, LandmarkVectors):
            total = total + landmark_log_likelihood(
                model, process, particles, centre, observation, trust
            )
            continue
        if isinstance(model, UavRanges | AnchorRanges) and not model.tags:
            block = model.linearize(process, centre, observation, near, derivatives=False)
            ranges, points = model.ends(observation, near)
            at = particles[..., :d]
            total = total + range_log_likelihood(block, ranges, at, points, trust, tails)
            continue
        around = per_state(observation, near)
        block = model.linearize(process, particles, *around, derivatives=False)
        trust = _per_particle(trust, total.dtype)
        variance = block.total_variance
        squared = trust.residual(block) ** 2 / variance
        if tails is not None:
            each = tails(squared.sum(-1), squared.shape[-1])
            if block.partner_variance is not None or block.varies:
                each = each - 0.5 * variance.log().sum(-1)
            each = each if trust.weight is None else each * trust.weight
            total = total + each.masked_fill(~block.mask, 0.0).sum(-1)
            continue
        if block.partner_variance is not None or block.varies:
            squared = squared + variance.log()
        if trust.weight is not None:
            squared = squared * trust.weight.unsqueeze(-1)
        log_density = -0.5 * squared.sum(-1)
        if block.stray:
            log_density = (log_density.exp() + block.stray).log()
        total = total + log_density.masked_fill(~block.mask, 0.0).sum(-1)
    return total


def _per_particle(trust: Trust, dtype: torch.dtype) -> Trust:
    """The same for every particle."""
    weight, shift = (
        None if x is None else x.to(dtype).unsqueeze(2) for x in (trust.weight, trust.shift)
    )
    return Trust(weight, shift)
