"""Particles drawn from a density: a Gaussian on the manifold, and the prior that a team states."""

import math

import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from agents.models.process import Process
from agents.particle.belief import normal, uniform
from coloc_env.geometry import concat, level, quaternion_product, yaw_quaternion
from coloc_env.scenario import Believed


def gaussian(
    process: Process,
    mean: Float[Tensor, "B N S"],
    covariance: Float[Tensor, "B N E E"],
    draws: Float32[Tensor, "B N M E"],
) -> Float32[Tensor, "B N M S"]:
    """x = x̄ ⊞ L ε ~ N(x̄, P) with P = L Lᵀ, from standard normal draws ε."""
    root = torch.linalg.cholesky_ex(covariance).L.to(draws.dtype)
    return process.boxplus(mean.to(draws.dtype).unsqueeze(-2), (root @ draws.mT).mT)


def from_prior(
    process: Process,
    believed: Believed,
    mean: Float32[Tensor, "B N S"],
    covariance: Float32[Tensor, "B N E E"],
    key: Int64[Tensor, "B N"],
    slots: int,
) -> Float32[Tensor, "B N M S"]:
    """x = x̄ ⊞ √diag(P) ε; where the prior is uniform, positions are so in the arena, and
    velocities within ±``max_speed`` along each axis where that is known, and so are headings where
    they may be any."""
    d = process.dim
    draws = normal(key, "pf.reset", process.error_size, slots)
    delta = draws * covariance.diagonal(dim1=-2, dim2=-1).sqrt().unsqueeze(-2)
    particles = process.boxplus(mean.unsqueeze(-2).expand(-1, -1, slots, -1), delta)
    if process.any_yaw and process.attitude_size:
        particles = _of_any_yaw(process, particles, key)
    if believed.prior.kind != "uniform":
        return particles
    low, high = (mean.new_tensor(x) for x in (believed.arena.low, believed.arena.high))
    place = low + uniform(key, "pf.place", d, slots) * (high - low)
    speed = believed.prior.max_speed
    if speed is None:
        return concat((place, particles[..., d:]))
    pace = speed * (2 * uniform(key, "pf.pace", d, slots) - 1)
    return concat((place, pace, particles[..., 2 * d :]))


def _of_any_yaw(
    process: Process, particles: Float32[Tensor, "B N M S"], key: Int64[Tensor, "B N"]
) -> Float32[Tensor, "B N M S"]:
    """The particles with a heading in (−π, π) of their own; roll and pitch stay."""
    slots, start, size = particles.shape[-2], 2 * process.dim, process.attitude_size
    yaw = math.pi * (2 * uniform(key, "pf.yaw", 1, slots) - 1)
    turned = yaw
    if size == 4:
        own = level(process.attitude(particles))
        turned = quaternion_product(yaw_quaternion(yaw[..., 0]), own)
    return concat((particles[..., :start], turned, particles[..., start + size :]))
