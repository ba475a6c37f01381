"""Mixture Monte Carlo localization (Thrun, Fox, Burgard & Dellaert 2001)."""

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from agents.models.process import Process
from agents.models.update import information, posterior
from agents.particle.belief import Step, normal
from agents.particle.cloud import Moments, moments, normalized
from agents.particle.filter import ParticleFilter, Particles, refuse_biases
from agents.particle.sampling import gaussian
from agents.particle.update import Foreseen
from coloc_env.options import Count, Quantity
from coloc_env.scenario import Believed

_ITERATIONS = 5  # of Gauss–Newton from the arena's centre
_WIDEN = 1.1  # of the covariance that is drawn from


@dataclass(frozen=True)
class _Gaussian:
    """On the manifold of a motion model's states."""

    mean: Float64[Tensor, "B N S"]
    covariance: Float64[Tensor, "B N E E"]

    def log(self, process: Process, x: Float32[Tensor, "B N M S"]) -> Float64[Tensor, "B N M"]:
        """Its density's logarithm."""
        mean = self.mean.to(x.dtype).unsqueeze(-2)
        return _log_normal(process.boxminus(x, mean).double(), self.covariance)


class MixtureParticleFilter(ParticleFilter):
    """Mixture MCL: a ``share`` of the particles is drawn from what a step measures and weighted by
    the motion prior; the others as a bootstrap filter has them.

    The observation's density g is the Gaussian that Gauss–Newton finds from the arena's centre,
    whose position knows nothing but this step's measurements (trilateration, landmarks); velocity
    and attitude have the predicted cloud's moments beside. Particles of both kinds weigh
    p(z | x) π(x) / ((1 − φ) π(x) + φ g(x)), φ being the share; π, the motion prior, is taken as the
    Gaussian with the predicted cloud's moments and, with the probability ``carried`` of having been
    carried since the step before, anywhere in the arena. No tempering and no redraw: the drawn
    particles are the remedy. All measurements are trusted alike.
    """

    name = "pf_mixture"

    def __init__(
        self,
        believed: Believed,
        *,
        particles: Particles = 500,
        seed: Count = 0,
        share: Annotated[float, Quantity("", 0.01, 0.5)] = 0.1,
        carried: Annotated[float, Quantity("", 0.0, below=1.0)] = 1e-6,
        cooperate: bool = True,
    ) -> None:
        super().__init__(
            believed, particles=particles, seed=seed, tempering=False, cooperate=cooperate
        )
        refuse_biases(self)
        self.every, self.carried = round(1 / share), carried

    def _foresee(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        u: Float32[Tensor, "B N 1 U"],
        dt: Float32[Tensor, "B N 1"],
        draws: Float32[Tensor, "B N M W"],
        now: Step,
    ) -> Foreseen:
        particles = self.process.propagate(particles, u, dt, draws)
        if self.models:
            particles, log_weights = self._mixed(particles, log_weights, now)
        gain = self._evidence(particles, log_weights, now)
        return particles, log_weights, gain, torch.zeros_like(now.belief.renewed)

    def _mixed(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        now: Step,
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"]]:
        """The predicted cloud with a share of the particles drawn from what is measured, and
        log-weights that make both stand for the motion prior."""
        process, m = self.process, particles.shape[-2]
        dual = torch.arange(m, device=particles.device) % self.every == self.every - 1
        count = int(dual.sum())
        kept = normalized(log_weights.masked_fill(dual, -torch.inf))
        cloud = moments(process, particles, kept.exp())
        density = self._observed(cloud, now)
        draws = normal(now.key, "pf.dual", process.error_size, m)
        drawn = gaussian(process, density.mean, density.covariance, draws)
        particles = torch.where(dual.unsqueeze(-1), drawn, particles)
        ratio = self._motion_prior(particles, cloud) - density.log(process, particles)
        share = count / m
        # π / ((1 − φ) π + φ g), whichever of the two a particle was drawn from
        factor = -torch.logaddexp(
            torch.full_like(ratio, math.log1p(-share)), math.log(share) - ratio
        )
        own = torch.where(dual, -math.log(m), kept + math.log1p(-share))
        return particles, normalized(own + factor.to(own.dtype))

    def _observed(self, cloud: Moments, now: Step) -> _Gaussian:
        """g: the Gaussian posterior of a prior that knows the arena of the position, and the
        cloud's moments of the rest."""
        process, d, arena = self.process, self.process.dim, self.believed.arena
        low, high = (cloud.covariance.new_tensor(end) for end in (arena.low, arena.high))
        x = cloud.mean.double()
        x = torch.cat(((0.5 * (low + high)).expand_as(x[..., :d]), x[..., d:]), -1)
        prior = _floored(cloud.covariance, self.resampling.floor)
        prior[..., :d, :] = prior[..., :, :d] = 0.0
        prior[..., :d, :d] = torch.diag((high - low) ** 2 / 12)
        state, delta, covariance = x, torch.zeros_like(prior[..., 0]), prior
        for _ in range(_ITERATIONS):
            blocks = [
                one.linearize(process, state, now.observation, now.neighbours)
                for one in self.models
            ]
            precision, vector = information(blocks, now.trusts)
            vector = vector + (precision @ delta.unsqueeze(-1))[..., 0]
            delta, covariance = posterior(prior, precision, vector)
            state = process.boxplus(x, delta)
        return _Gaussian(state, _WIDEN * covariance)

    def _motion_prior(
        self, x: Float32[Tensor, "B N M S"], cloud: Moments
    ) -> Float64[Tensor, "B N M"]:
        """log π(x): of the Gaussian with the cloud's moments and, at ``carried``, of a position
        anywhere in the arena."""
        process, d, arena = self.process, self.process.dim, self.believed.arena
        covariance = _floored(cloud.covariance, self.resampling.floor)
        away = process.boxminus(x, cloud.mean.unsqueeze(-2)).double()
        near = _log_normal(away, covariance)
        if not self.carried:
            return near
        volume = math.prod(b - a for a, b in zip(arena.low, arena.high, strict=True))
        far = _log_normal(away[..., d:], covariance[..., d:, d:]) - math.log(volume)
        return torch.logaddexp(near + math.log1p(-self.carried), far + math.log(self.carried))


def _floored(
    covariance: Float64[Tensor, "B N E E"], floor: Float64[Tensor, "E"]
) -> Float64[Tensor, "B N E E"]:
    """Never of less than the standard deviations of a ``floor``."""
    return covariance + torch.diag(floor.to(covariance.device) ** 2)


def _log_normal(
    x: Float64[Tensor, "B N M e"], covariance: Float64[Tensor, "B N e e"]
) -> Float64[Tensor, "B N M"]:
    """log N(x; 0, P) = −½ ‖L⁻¹ x‖² − Σ log L_ii − ½ e log 2π, P = L Lᵀ."""
    root = torch.linalg.cholesky_ex(covariance).L
    scaled = torch.linalg.solve_triangular(root, x.mT, upper=False)
    fixed = root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    fixed = fixed + 0.5 * x.shape[-1] * math.log(2 * math.pi)
    return -0.5 * scaled.square().sum(-2) - fixed.unsqueeze(-1)
