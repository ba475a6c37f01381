"""Log-likelihoods of particles by landmark vectors, of any landmark of the map or one by one."""

import math

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from agents.association.clutter import log_mixture
from agents.models.measurements import LandmarkVectors
from agents.models.process import Process
from agents.robust.heavy_tails import LogDensity, gaussian_log_density
from coloc_env.observation import Observation
from coloc_env.sensors.base import usable


def any_landmark_log_likelihood(
    model: LandmarkVectors,
    process: Process,
    particles: Float32[Tensor, "B N M S"],
    centre: Float32[Tensor, "B N S"],
    observation: Observation,
    volume: float,
    tails: LogDensity | None,
) -> Float32[Tensor, "B N M"]:
    """Σ_m log(ε / V + (1 − ε) / L · Σ_l N(z_m; Rᵀ(L_l − p), σ² I)): each vector may be of any of
    the map's L landmarks, all as likely, or clutter. ``tails``: another density than the Gaussian.
    """
    d = process.dim
    z = observation["unlabelled_landmarks"].unflatten(-1, (-1, d))
    z, there = usable(z, observation["unlabelled_landmark_mask"] > 0)
    z, there = _present(z, there)
    each = _log_densities(
        process, particles, centre, z, observation["landmark_map"], model.std, tails
    )
    log_p = log_mixture(each, volume, -2)  # [B, N, m, M]
    return log_p.masked_fill(~there.unsqueeze(-1), 0.0).sum(-2)


def _present(
    z: Float32[Tensor, "B N m d"], there: Bool[Tensor, "B N m"]
) -> tuple[Float32[Tensor, "B N k d"], Bool[Tensor, "B N k"]]:
    """Without the slots in which no UAV has measured anything: what is there comes first."""
    most = max(1, int(there.sum(-1).max())) if there.numel() else 0
    order = there.to(torch.int8).argsort(dim=-1, descending=True, stable=True)[..., :most]
    return z.gather(-2, order.unsqueeze(-1).expand(*order.shape, z.shape[-1])), there.gather(
        -1, order
    )


def _log_densities(
    process: Process,
    particles: Float32[Tensor, "B N M S"],
    centre: Float32[Tensor, "B N S"],
    z: Float32[Tensor, "B N m d"],
    points: Float32[Tensor, "B N L*d"],
    std: float,
    tails: LogDensity | None,
) -> Float32[Tensor, "B N m L M"]:
    """log p(z | l) from s = ‖e − L‖²/σ² = (‖e‖² + ‖L‖² − 2 e·L)/σ², e = p + R z: a product of
    matrices. All places are about the centre's, which keeps float32 from cancelling."""
    d = process.dim
    rotation = process.rotation(particles)
    if rotation is None:
        raise ValueError("landmark vectors are in the body frame: the motion model has no attitude")
    at = particles[..., :d] - centre[..., None, :d]
    ends = (at.unsqueeze(-2) + z.unsqueeze(2) @ rotation.mT).permute(0, 1, 3, 4, 2)  # m, d, M
    known = points.unflatten(-1, (-1, d)) - centre[..., None, :d]
    square, one = ends.square().sum(-2, keepdim=True), torch.ones_like(ends[..., :1, :])
    lengths = known.square().sum(-1, keepdim=True)
    by = torch.cat((torch.ones_like(lengths), lengths, -2 * known), -1) / std**2
    if tails is None:  # log N = −s/2 + const: the constant goes into the column of ones
        by = -0.5 * by
        by[..., 1] += gaussian_log_density(by.new_zeros(()), d) - d * math.log(std)
    each = by.unsqueeze(2) @ torch.cat((square, one, ends), -2)
    return each if tails is None else tails(each.clamp_min(0.0), d) - d * math.log(std)


def each_landmark_log_likelihood(
    model: LandmarkVectors,
    process: Process,
    particles: Float32[Tensor, "B N M S"],
    observation: Observation,
    weight: Float32[Tensor, "B N L"] | None,
    tails: LogDensity,
) -> Float32[Tensor, "B N M"]:
    """Σ w log p(z − Rᵀ(L − p)) over landmarks with names, of a density with heavy tails."""
    d = process.dim
    z, there = model.read(observation, d)
    rotation = process.rotation(particles)
    if rotation is None:
        raise ValueError("landmark vectors are in the body frame: the motion model has no attitude")
    points = observation["landmark_map"].unflatten(-1, (-1, d)).unsqueeze(2)
    apart = z.unsqueeze(2) @ rotation.mT + particles[..., None, :d] - points
    each = tails(sum_of_squares(apart) / model.std**2, d)
    counted = there if weight is None else there * weight.to(each.dtype)
    return (each * counted.unsqueeze(2)).sum(-1)


def sum_of_squares(x: Float32[Tensor, "*s d"]) -> Float32[Tensor, "*s"]:
    parts = [part.square() for part in x.unbind(-1)]
    return sum(parts[1:], parts[0])
