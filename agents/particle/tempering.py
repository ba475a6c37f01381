"""Adaptive tempering: evidence that is used in stages, each as large as keeps particles alive."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from agents.particle import particle_count
from agents.particle.belief import normal
from agents.particle.cloud import effective_sample_size, moments, normalized
from agents.particle.resampling import RESAMPLE, Resampling
from coloc_env import noise

# Log-likelihoods of particles, given their log-weights (linearized at the heaviest).
Evidence = Callable[
    [Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"]], Float32[Tensor, "B N M"]
]

_BISECTIONS = 10
_SMALLEST = math.log(1e-9)  # of what is left: no likelihood is sharper than that
_STAGES = 40  # more than any likelihood has needed


def increment(
    log_weights: Float32[Tensor, "B N M"],
    log_likelihood: Float32[Tensor, "B N M"],
    left: Float32[Tensor, "B N"],
    goal: Float32[Tensor, "B N"],
) -> Float32[Tensor, "B N"]:
    """The largest share β ≤ ``left`` of the log-likelihood that keeps the effective sample size at
    ``goal`` particles, by bisection of log β (adaptive tempering, Del Moral, Doucet & Jasra 2012).
    """

    def enough(beta: Tensor) -> Tensor:
        return effective_sample_size(log_weights + beta.unsqueeze(-1) * log_likelihood) >= goal

    low, high = torch.full_like(left, _SMALLEST), torch.zeros_like(left)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        good = enough(left * middle.exp())
        low, high = torch.where(good, middle, low), torch.where(good, high, middle)
    return torch.where(enough(left), left, left * low.exp())


def tempered(
    particles: Float32[Tensor, "B N M S"],
    log_weights: Float32[Tensor, "B N M"],
    gain: Float32[Tensor, "B N M"],
    staged: Bool[Tensor, "B N"],
    evidence: Evidence,
    resampling: Resampling,
    count: Int64[Tensor, "B N"],
    key: Int64[Tensor, "B N"],
) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"]]:
    """The evidence in stages for some UAVs, w ← w exp(β gain) with Σβ = 1 and a resampling move
    between stages, drawn from ``key``; at once for the others. ``gain`` is the evidence about the
    particles given, ``count`` how many of them live."""
    equal = particle_count.equal_log_weights(particle_count.alive(count, particles.shape[-2]))
    left = torch.ones_like(gain[..., 0])
    for stage in range(_STAGES):
        share = left
        if stage < _STAGES - 1:
            some = increment(log_weights, gain, left, RESAMPLE * count.to(torch.float32))
            share = torch.where(staged, some, left)
        used = normalized(log_weights + share.unsqueeze(-1) * gain)
        log_weights = torch.where((left > 0).unsqueeze(-1), used, log_weights)
        left = left - share
        go_on = left > 0
        if not bool(go_on.any()):
            break
        weights = log_weights.exp()
        own = noise.fold(key, stage)
        draws = normal(own, "pf.move", resampling.space.error_size, weights.shape[-1])
        cloud = moments(resampling.space, particles, weights)
        moved = resampling.resample(cloud, weights, count, draws, own)
        particles = torch.where(go_on[..., None, None], moved, particles)
        log_weights = torch.where(go_on.unsqueeze(-1), equal, log_weights)
        gain = evidence(particles, log_weights)
    return particles, log_weights
