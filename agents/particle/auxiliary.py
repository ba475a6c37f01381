"""The auxiliary particle filter (Pitt & Shephard 1999), with the kernel of Liu & West (2001)."""

import math

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from agents.particle.belief import Step, normal
from agents.particle.cloud import (
    effective_sample_size,
    liu_west,
    moments,
    normalized,
    systematic,
)
from agents.particle.filter import ParticleFilter, Particles, refuse_biases
from agents.particle.particle_count import alive, equal_log_weights
from agents.particle.resampling import FLOOR, RESAMPLE, SHRINKAGE, Resampling, Weighed, per_error
from agents.particle.update import Foreseen, Renewal
from coloc_env import noise
from coloc_env.options import Count
from coloc_env.scenario import Believed


class AuxiliaryParticleFilter(ParticleFilter):
    """Auxiliary particle filter: it looks at a step's measurements before it resamples.

    First stage: ancestors are drawn by w p(z | μ), μ being where a particle will be without noise,
    where that leaves less than half of the particles effective; they are moved by Liu and West's
    kernel (2001), about whose centres μ is taken. Second stage: w ∝ p(z | x) / p(z | μ) of their
    ancestors. Nothing is resampled at a step's end. Where even the first stage leaves too few
    (the first steps; a cloud that is lost), the step and its remedies (``tempering``, ``renewal``)
    are those of ``pf500``. All measurements are trusted alike.
    """

    name = "pf_auxiliary"

    def __init__(
        self,
        believed: Believed,
        *,
        particles: Particles = 500,
        seed: Count = 0,
        tempering: bool = True,
        renewal: Renewal = "ekf",
        cooperate: bool = True,
    ) -> None:
        super().__init__(
            believed,
            particles=particles,
            seed=seed,
            tempering=tempering,
            renewal=renewal,
            cooperate=cooperate,
        )
        refuse_biases(self)
        self.resampling = _Selected(self.process, per_error(self.process, FLOOR), None)

    def _foresee(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        u: Float32[Tensor, "B N 1 U"],
        dt: Float32[Tensor, "B N 1"],
        draws: Float32[Tensor, "B N M W"],
        now: Step,
    ) -> Foreseen:
        process, (m, size) = self.process, (particles.shape[-2], self.process.error_size)
        cloud = moments(process, particles, log_weights.exp())
        shrunk = math.sqrt(1 - SHRINKAGE**2) * (cloud.apart - cloud.shift.unsqueeze(-2))
        centres = process.boxplus(cloud.mean.unsqueeze(-2), shrunk)
        ahead = self._evidence(process.propagate(centres, u, dt), log_weights, now)
        first = normalized(log_weights + ahead)  # w p(z | μ)
        few = self._degenerate(first, now)
        rows = (effective_sample_size(first) < RESAMPLE * self.particles) & ~few
        ancestors = systematic(first.exp(), noise.unit(now.key))
        moves = normal(now.key, "pf.step", size, m, process.noise_size)
        floor = self.resampling.floor.to(particles.device)
        moved = liu_west(process, cloud, ancestors, moves, SHRINKAGE, floor)
        equal = equal_log_weights(alive(now.belief.count, m))
        particles = torch.where(rows[..., None, None], moved, particles)
        log_weights = torch.where(rows.unsqueeze(-1), equal, log_weights)
        particles, log_weights, gain, _ = super()._foresee(
            particles, log_weights, u, dt, draws, now
        )
        looked = ahead.gather(-1, ancestors).masked_fill(~rows.unsqueeze(-1), 0.0)
        return particles, log_weights, gain - looked, few  # p(z | x) / p(z | μ)


class _Selected(Resampling):
    """The first stage has resampled."""

    @staticmethod
    def few(weighed: Weighed, count: Int64[Tensor, "B N"]) -> Bool[Tensor, "B N"]:
        return torch.zeros_like(count, dtype=torch.bool)
