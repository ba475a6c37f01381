"""The Rao–Blackwellized particle filter (Doucet, de Freitas, Murphy & Russell 2000; marginalized as
Schön, Gustafsson & Nordlund 2005)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Float32, Float64
from torch import Tensor

from agents.errors import NotServed
from agents.kalman.filter import elapsed
from agents.models.measurements import per_state
from agents.models.update import posterior
from agents.particle.belief import ParticleBelief, Step, normal
from agents.particle.cloud import select
from agents.particle.filter import ParticleFilter, Particles, refuse_biases
from agents.particle.likelihood import log_likelihood
from agents.particle.update import Updated
from coloc_env.geometry import concat
from coloc_env.observation import Observation
from coloc_env.options import Count
from coloc_env.scenario import Believed

_LEAST = 1e-6  # m: of a position's step, whose covariance must have a root


@dataclass(frozen=True)
class _Seen:
    """rᵀ R⁻¹ r and Hᵀ R⁻¹ r of each particle's residuals, H being the Jacobian of the rest, and the
    rest's covariance P⁺ = (P⁻¹ + Hᵀ R⁻¹ H)⁻¹ once these are used."""

    squared: Float32[Tensor, "B N M"]
    vector: Float32[Tensor, "B N M L"]
    conditional: Float64[Tensor, "B N L L"]

    @property
    def log_likelihood(self) -> Float32[Tensor, "B N M"]:
        """log N(r; 0, R + H P Hᵀ) + const = −½ rᵀ R⁻¹ r + ½ bᵀ P⁺ b with b = Hᵀ R⁻¹ r."""
        gained = (self.vector @ self.conditional.to(self.vector.dtype)) * self.vector
        return 0.5 * (gained.sum(-1) - self.squared)

    def where(self, rows: Bool[Tensor, "B N"], other: _Seen) -> _Seen:
        """This one for the UAVs marked, another for the rest."""
        one, two = rows.unsqueeze(-1), rows[..., None, None]
        return _Seen(
            torch.where(one, self.squared, other.squared),
            torch.where(two, self.vector, other.vector),
            torch.where(two, self.conditional, other.conditional),
        )


class RaoBlackwellFilter(ParticleFilter):
    """Rao–Blackwellized particle filter: particles of the position alone.

    Velocity, attitude and biases are marginalized: each particle carries their conditional mean,
    and a Kalman filter's conditional covariance, linearized at the cloud's mean, which all of a
    UAV's particles share. A step draws a particle's position, from which the rest learns as from a
    measurement; the measurements' likelihood is p(z | position), the rest integrated out; then
    the rest is updated by them. Exact in linear Gaussian models. Likelihoods that leave too few
    particles are tempered, and Liu–West moves follow, as in ``pf500``; nothing is redrawn from an
    EKF. All measurements are trusted alike.
    """

    name = "pf_rao_blackwell"

    def __init__(
        self,
        believed: Believed,
        *,
        particles: Particles = 500,
        seed: Count = 0,
        tempering: bool = True,
        cooperate: bool = True,
    ) -> None:
        super().__init__(
            believed,
            particles=particles,
            seed=seed,
            tempering=tempering,
            renewal="none",
            cooperate=cooperate,
        )
        refuse_biases(self)
        if self.process.error_size == self.process.dim:
            raise NotServed("the motion model has positions alone: nothing to marginalize")

    def reset(self, observation: Observation) -> ParticleBelief:
        """Positions drawn from the prior; of the rest, its mean and covariance."""
        belief, d = super().reset(observation), self.process.dim
        mean, covariance = self.process.initial(observation["prior"])
        particles = mean.unsqueeze(-2).expand_as(belief.particles)
        particles = concat((belief.particles[..., :d], particles[..., d:]))
        return belief.replace(particles=particles, conditional=covariance[..., d:, d:].double())

    def restart_from(
        self,
        belief: ParticleBelief,
        rows: Bool[Tensor, "B N"],
        state: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N E E"],
    ) -> ParticleBelief:
        """The rest is drawn, too: beside each draw nothing of it is unknown."""
        after = super().restart_from(belief, rows, state, covariance)
        kept = belief.conditional.masked_fill(rows[..., None, None], 0.0)
        return after.replace(conditional=kept)

    def _updated(self, now: Step) -> Updated:
        process, belief, d = self.process, now.belief, self.process.dim
        spread, conditional = self._predicted(now)
        draws = normal(now.key, "pf.step", d, self.capacity)
        u = process.inputs(now.observation).to(draws.dtype).unsqueeze(-2)
        dt = elapsed(process, belief.step).to(draws.dtype).unsqueeze(-1)
        particles = process.propagate(belief.particles, u, dt)
        particles = process.boxplus(particles, (spread.to(draws.dtype) @ draws.mT).mT)
        log_weights, renewed = belief.log_weights, torch.zeros_like(belief.renewed)
        if not self.models:
            return Updated(particles, log_weights, renewed, None, conditional)
        now = replace(now, belief=belief.replace(conditional=conditional))
        seen = self._seen(particles, log_weights, now)
        few = self._degenerate(log_weights + seen.log_likelihood, now)
        if bool(few.any()):
            found = self._rejuvenated(particles, log_weights, seen.log_likelihood, few, now)
            particles, log_weights, _ = found
            seen = seen.where(~few, self._seen(particles, log_weights, now))
        else:
            log_weights = log_weights + seen.log_likelihood
        rest = seen.vector @ seen.conditional.to(draws.dtype)  # δ = P⁺ Hᵀ R⁻¹ r
        delta = concat((torch.zeros_like(draws), rest))
        particles = process.boxplus(particles, delta)
        return Updated(particles, log_weights, renewed, None, seen.conditional)

    def _predicted(
        self, now: Step
    ) -> tuple[Float64[Tensor, "B N E d"], Float64[Tensor, "B N L L"]]:
        """What a standard normal draw moves a particle by, x' = f(x) ⊞ [L; C L⁻ᵀ] ε, and the
        covariance V − C S⁻¹ Cᵀ of the rest once it has moved, the joint covariance of position
        and rest after the step being [S, Cᵀ; C, V] = F_l P F_lᵀ + Q, S = L Lᵀ."""
        process, belief, d = self.process, now.belief, self.process.dim
        mean, dt = self.mean(belief).double(), elapsed(process, belief.step).double()
        f, q = process.linearize(mean, process.inputs(now.observation), dt)
        joint = f[..., d:] @ belief.conditional @ f[..., d:].mT + q
        least = _LEAST**2 * torch.eye(d, dtype=joint.dtype, device=joint.device)
        root = torch.linalg.cholesky_ex(joint[..., :d, :d] + least).L
        learned = torch.linalg.solve_triangular(root, joint[..., :d, d:], upper=False).mT
        rest = joint[..., d:, d:] - learned @ learned.mT
        return torch.cat((root, learned), -2), 0.5 * (rest + rest.mT)

    def _evidence(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        now: Step,
    ) -> Float32[Tensor, "B N M"]:
        return self._seen(particles, log_weights, now).log_likelihood

    def _seen(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        now: Step,
    ) -> _Seen:
        """A step's measurements, linearized in the rest at the heaviest particle."""
        process, d, prior = self.process, self.process.dim, now.belief.conditional
        centre = select(particles, log_weights.argmax(-1, keepdim=True))[..., 0, :].double()
        around = per_state(now.observation, now.neighbours)
        squared = torch.zeros_like(log_weights)
        vector = particles.new_zeros(*log_weights.shape, prior.shape[-1])
        precision = torch.zeros_like(prior)
        for model, trust in zip(self.models, now.trusts, strict=True):
            block = model.linearize(process, centre, now.observation, now.neighbours)
            h = block.jacobian.flatten(-3, -2)[..., d:]
            if not bool(h.any()):  # of the position alone
                heaviest = centre.to(particles.dtype)
                now_seen = now.observation, now.neighbours, [trust]
                alone = log_likelihood([model], process, particles, heaviest, *now_seen)
                squared = squared - 2 * alone
                continue
            inverse = trust.information(block).flatten(-2)  # R⁻¹
            scaled = h * inverse.unsqueeze(-1)
            precision = precision + h.mT @ scaled
            each = model.linearize(process, particles, *around, derivatives=False)
            r = each.residual.masked_fill(~each.mask.unsqueeze(-1), 0.0)
            r = r.flatten(-2).to(particles.dtype)
            # As products whose rounding does not depend on how many UAVs there are.
            squared = squared + (r.square() * inverse.to(r.dtype).unsqueeze(-2)).sum(-1)
            vector = vector + (scaled.mT.to(r.dtype) @ r.mT).mT
        after = posterior(prior, precision, torch.zeros_like(prior[..., 0]))[1]
        return _Seen(squared, vector, after)
