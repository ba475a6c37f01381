"""Prediction and measurement update of a cloud of particles, with what is done where few count."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from torch import Tensor

from agents.association import Association
from agents.kalman.filter import elapsed
from agents.localizer import Localizer
from agents.models.biases import Biases
from agents.models.measurements import Measurement
from agents.models.process import Process
from agents.particle import particle_count
from agents.particle.belief import ParticleBelief, Step, normal
from agents.particle.cloud import select
from agents.particle.degeneracy import Rejuvenation, degenerate
from agents.particle.likelihood import log_likelihood
from agents.particle.proposal import ImportanceDensity, draw, importance_density
from agents.particle.resampling import Resampling
from agents.robust import Screen
from agents.robust.heavy_tails import LogDensity

Proposal = Literal["prior", "ekf"]
Renewal = Literal["ekf", "none"]
Foreseen = tuple[
    Float32[Tensor, "B N M S"],
    Float32[Tensor, "B N M"],
    Float32[Tensor, "B N M"],
    Bool[Tensor, "B N"],
]  # particles, log-weights, log-likelihoods, whether too few count


@dataclass(frozen=True)
class Updated:
    """A cloud after a step's measurements: particles, log-weights (not normalized), which UAVs'
    were redrawn from an EKF's posterior, the Gaussian update beside it where anything asks for one,
    and the covariance of what particles hold only the mean of."""

    particles: Float32[Tensor, "B N M S"]
    log_weights: Float32[Tensor, "B N M"]
    renewed: Bool[Tensor, "B N"]
    density: ImportanceDensity | None
    conditional: Float64[Tensor, "B N L L"]


class CloudUpdate(Localizer[ParticleBelief]):
    """The part of a particle filter between its belief and its resampling:

    x ~ p(x | x⁻, u), w ← w p(z | x).

    ``models`` of measurements that ``screen`` weighs; ``tails``: another density than the Gaussian,
    ``heavy`` the screen that stands for it in a Gaussian update; landmarks without names get some
    by ``association``, or may be of any, beside clutter in a ``volume`` (m³).
    """

    process: Process
    models: list[Measurement]
    screen: Screen
    tails: LogDensity | None
    heavy: Screen | None
    association: Association | None
    volume: float | None
    resampling: Resampling
    capacity: int
    bounds: tuple[int, int] | None
    tempering: bool
    renewal: Renewal
    proposal: Proposal
    compiled: bool

    def log_correction(
        self, particles: Float32[Tensor, "B N M S"], belief: ParticleBelief
    ) -> Float32[Tensor, "B N M"] | None:
        """What a learned part adds to the log-likelihood of particles: nothing here."""
        return None

    def _slots(self, count: Int64[Tensor, "B N"]) -> int:
        """How many slots the step works on: enough for any UAV of the batch to grow into; all of
        them where each number would be compiled for."""
        if self.bounds is None or self.compiled:
            return self.capacity
        return min(self.capacity, int(count.max()) + particle_count.GROW)

    def _updated(self, now: Step) -> Updated:
        """Prediction x ~ p(x | x⁻, u) and update w ← w p(z | x)."""
        belief = now.belief
        slots = self._slots(belief.count)
        particles, log_weights = belief.particles[..., :slots, :], belief.log_weights[..., :slots]
        draws = normal(now.key, "pf.step", self.process.noise_size, slots)
        u = self.process.inputs(now.observation).to(torch.float32).unsqueeze(-2)
        dt = elapsed(self.process, belief.step).to(torch.float32).unsqueeze(-1)
        density, renewed = None, torch.zeros_like(belief.renewed)
        if self.models and (self._paired or self._judged):
            particles = self.process.propagate(particles, u, dt, draws)
            density = importance_density(
                self.screen, self.resampling.floor, particles, log_weights, now
            )
            now = replace(now, trusts=density.posterior.trusts)
            if self._paired:
                now = replace(now, observation=density.prior.observation)
            if self.proposal == "ekf":
                particles, log_weights = draw(self.process, density, now, slots)
                renewed = ~renewed
            gain = self._evidence(particles, log_weights, now)
            few = self._degenerate(log_weights + gain, now)
        else:
            foreseen = self._foresee(particles, log_weights, u, dt, draws, now)
            particles, log_weights, gain, few = foreseen
        if not (self.models and bool(few.any())):
            return Updated(particles, log_weights + gain, renewed, density, belief.conditional)
        found = self._rejuvenated(particles, log_weights, gain, few, now, density)
        return Updated(found[0], found[1], renewed | found[2], density, belief.conditional)

    def _rejuvenated(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        gain: Float32[Tensor, "B N M"],
        few: Bool[Tensor, "B N"],
        now: Step,
        density: ImportanceDensity | None = None,
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"], Bool[Tensor, "B N"]]:
        """What ``Rejuvenation`` makes of evidence that leaves too ``few``."""
        evidence, renews = partial(self._evidence, now=now), self.renewal == "ekf"
        rejuvenation = Rejuvenation(
            evidence, self.screen, self.resampling, now, renews, self.heavy or self.screen
        )
        return rejuvenation.rejuvenate(particles, log_weights, gain, few, density)

    def _foresee(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        u: Float32[Tensor, "B N 1 U"],
        dt: Float32[Tensor, "B N 1"],
        draws: Float32[Tensor, "B N M W"],
        now: Step,
    ) -> Foreseen:
        """Each particle propagated with its own draw of process noise, its log-weight before the
        evidence, its log-likelihood, and whether that leaves too few."""
        particles = self.process.propagate(particles, u, dt, draws)
        gain = self._evidence(particles, log_weights, now)
        return particles, log_weights, gain, self._degenerate(log_weights + gain, now)

    def _degenerate(self, log_weights: Float32[Tensor, "B N M"], now: Step) -> Bool[Tensor, "B N"]:
        """Whose weights are those of too few particles, which tempering would mend."""
        if not self.tempering:
            return torch.zeros_like(log_weights[..., 0], dtype=torch.bool)
        return degenerate(log_weights, now.belief.count, now.belief.step)

    def _evidence(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        now: Step,
    ) -> Float32[Tensor, "B N M"]:
        """Log-likelihood of each particle, and its learned correction."""
        centre = select(particles, log_weights.argmax(-1, keepdim=True))[..., 0, :]
        evidence = now.observation, now.neighbours, now.trusts
        gain = log_likelihood(
            self.models, self.process, particles, centre, *evidence, self.tails, self.volume
        )
        correction = self.log_correction(particles, now.belief)
        return gain if correction is None else gain + correction

    @property
    def _judged(self) -> bool:
        """Whether every step needs a Gaussian update beside the particles."""
        return self.screen.judges or self.proposal == "ekf" or bool(self.biases)

    @property
    def _paired(self) -> bool:
        """Whether landmarks without names get some, the same for all particles."""
        return self.association is not None and self.volume is None

    @property
    def biases(self) -> Biases:
        return Biases(self.models, self.process.dt)

    def _considered(self, now: Step, density: ImportanceDensity | None) -> Float[Tensor, "B N E G"]:
        """What biases make of the error in this step, with the gains of the Gaussian update."""
        belief, seen = now.belief, now.observation
        if density is None or not self.biases:
            return belief.considered
        dt = elapsed(self.process, belief.step).double()
        before = self.mean(belief).double()
        f, _ = self.process.linearize(before, self.process.inputs(seen), dt)
        considered = self.biases.predict(belief.considered, f, seen)
        found = density.posterior
        return self.biases.of_update(
            considered,
            density.prior.covariance,
            found.covariance,
            found.blocks,
            found.trusts,
            seen,
        )
