"""SIR particle filters with Liu-West regularization and adaptive tempering, one per UAV.

Gordon, Salmond & Smith 1993; resampling when the effective sample size falls below half.
Neighbours' messages enter as ranges whose variance is inflated by the sender's own uncertainty.
Particles live in padded tensors with a live count per UAV, fixed or adaptive (PF-NN paper,
Algorithms 1 and 2).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from agents.ekf import elapsed
from agents.localizer import Estimate, Localizer, register
from agents.models.measurements import Neighbours, heard, make_measurements
from agents.models.process import make_process
from agents.models.update import Update, iterated_update, linearizer
from agents.particles import population
from agents.particles.belief import ParticleBelief, normal, own_keys
from agents.particles.cloud import (
    effective_sample_size,
    moments,
    normalized,
    select,
)
from agents.particles.likelihood import log_likelihood
from agents.particles.renewal import (
    FLOOR,
    RESAMPLE,
    Perturb,
    Renewal,
    padded,
    padded_weights,
)
from agents.particles.tempering import increment
from agents.robust import Prediction, RobustScreen, Screen, Trust
from coloc_env import noise
from coloc_env.geometry import concat
from coloc_env.observation import Observation
from coloc_env.scenario import Believed

Proposal = Literal["prior", "ekf"]

_START_STEPS = 3  # steps in which the likelihood is tempered down to that share
_RESCUE = 0.1  # the share below which particles are drawn anew later
_STAGES = 40  # more than any likelihood has needed
_WIDEN = 1.1  # of the guided proposal's covariance
_ITERATIONS = 3  # of the update that screens measurements and guides proposals


@dataclass(frozen=True)
class _Step:
    """What a step's evidence is made from."""

    belief: ParticleBelief
    observation: Observation
    neighbours: Neighbours
    trusts: Sequence[Trust]
    key: Int64[Tensor, "B N"]


@dataclass(frozen=True)
class _Guide:
    """A Gaussian prior at a predicted cloud's moments, and its update by the measurements."""

    prior: Prediction
    found: Update


class ParticleFilter(Localizer[ParticleBelief]):
    """Bootstrap filter; its number of particles is fixed unless ``bounds`` let it adapt.

    ``perturb``: ``liu_west`` moves resampled particles so that the cloud keeps its moments, above a
    small floor; ``fixed`` adds N(0, Σ_perturb) instead (the paper's way). A likelihood that leaves
    few particles is used in stages in the first steps; later, particles are drawn anew from 1.1 ×
    an EKF's posterior about the cloud's moments, with exact weights (Kotecha & Djurić 2003) if
    enough survive those; ``proposal=ekf`` does so at every step.
    ``tempering=false`` uses every likelihood as it comes.
    ``robust``, ``gate``: as ``ekf`` has them, decided by a Gaussian update at the cloud's moments.
    ``compile=true`` compiles the step's two large parts at the first step (it takes up to a minute
    and needs a C++ compiler); the numbers then differ in their last digits.
    """

    name = "pf"

    def __init__(
        self,
        believed: Believed,
        *,
        particles: int,
        bounds: tuple[int, int] | None = None,
        seed: int = 0,
        perturb: Perturb = "liu_west",
        tempering: bool = True,
        proposal: Proposal = "prior",
        robust: str = "none",
        gate: float = 0.999,
        cooperate: bool = True,
        compile: bool = False,
    ) -> None:
        super().__init__(believed)
        if particles < 10:
            raise ValueError(f"particles={particles} is not allowed: at least 10")
        if bounds is not None and not 10 <= bounds[0] <= particles <= bounds[1]:
            raise ValueError(
                f"bounds={bounds} is not allowed: low,high with 10 ≤ low ≤ particles ({particles}) "
                "≤ high"
            )
        self.particles, self.seed, self.tempering = particles, seed, tempering
        self.bounds, self.proposal = bounds, proposal
        self.capacity = particles if bounds is None else bounds[1]
        self.process = make_process(believed)
        self.models = [m for m in make_measurements(believed) if cooperate or not m.cooperative]
        self.screen: Screen = RobustScreen(self.process, self.models, robust, gate)
        self.renewal = Renewal(self.process, perturb, bounds)
        self.compiled = compile
        if compile:
            self._foresee = torch.compile(self._foresee, dynamic=False)  # type: ignore[method-assign]
            self.renewal.conclude = torch.compile(self.renewal.conclude, dynamic=False)  # type: ignore[method-assign]

    @property
    def exchanges(self) -> bool:
        return self.screen.exchanges

    def reset(self, observation: Observation) -> ParticleBelief:
        prior = observation["prior"]
        mean, covariance = self.process.initial(prior)
        key = own_keys(observation, self.seed)
        m, d = self.capacity, self.process.dim
        draws = normal(key, "pf.reset", self.process.error_size, m)
        delta = draws * covariance.diagonal(dim1=-2, dim2=-1).sqrt().unsqueeze(-2)
        particles = self.process.boxplus(mean.unsqueeze(-2).expand(-1, -1, m, -1), delta)
        if self.believed.prior.kind == "uniform":
            arena = self.believed.arena
            low, high = (prior.new_tensor(x) for x in (arena.low, arena.high))
            place = (normal(key, "pf.place", d, m) * 0.5**0.5).erf() * 0.5 + 0.5
            particles = concat((low + place * (high - low), particles[..., d:]))
        count = torch.full_like(key, self.particles)
        live = population.alive(count, m)
        return ParticleBelief(
            particles=torch.where(live.unsqueeze(-1), particles, mean.unsqueeze(-2)),
            log_weights=population.equal_log_weights(live),
            count=count,
            key=key,
            step=torch.zeros_like(key),
            ess_share=torch.ones_like(prior[..., 0]),
            last=mean[..., : 2 * d],
            memory=self.screen.memory(observation),
            batch_size=key.shape,
        )

    def step(
        self, belief: ParticleBelief, observation: Observation
    ) -> tuple[ParticleBelief, Estimate]:
        key = noise.fold(belief.key, belief.step)
        slots, w = self._slots(belief.count), self.process.noise_size
        draws = normal(key, "pf.step", w + self.process.error_size, slots)
        u = self.process.inputs(observation).to(torch.float32).unsqueeze(-2)
        dt = elapsed(self.process, belief.step).to(torch.float32).unsqueeze(-1)
        neighbours = heard(self.believed, observation)
        particles, log_weights = belief.particles[..., :slots, :], belief.log_weights[..., :slots]
        now = _Step(belief, observation, neighbours, [Trust()] * len(self.models), key)
        memory = belief.memory
        if self.models and (self.screen.judges or self.proposal == "ekf"):
            particles = self.process.propagate(particles, u, dt, draws[..., :w])
            guide = self._guide(particles, log_weights, now)
            now, memory = replace(now, trusts=guide.found.trusts), guide.found.memory
            if self.proposal == "ekf":
                particles, log_weights = self._drawn(guide, now, slots)
            gain = self._evidence(particles, log_weights, now)
            short = self._short(log_weights + gain, now)
        else:
            guide = None
            particles, gain, short = self._foresee(
                particles, log_weights, u, dt, draws[..., :w], now
            )
        if self.tempering and self.models and bool(short.any()):
            particles, log_weights = self._rescued(particles, log_weights, gain, short, guide, now)
        else:
            log_weights = log_weights + gain
        particles, log_weights, cloud, ess, target = self.renewal.conclude(
            particles, log_weights, belief.count, draws[..., w:], key
        )
        particles, log_weights = self.renewal.shrunk(
            particles, log_weights, cloud, belief.count, target
        )
        d = self.process.dim
        least = torch.eye(d, dtype=torch.float64, device=key.device) * FLOOR["position"] ** 2
        estimate = Estimate(
            position=cloud.mean[..., :d],
            velocity=cloud.mean[..., d : 2 * d],
            covariance=cloud.covariance[..., :d, :d] + least,
            batch_size=key.shape,
        )
        after = ParticleBelief(
            particles=padded(particles, cloud.mean, self.capacity),
            log_weights=padded_weights(log_weights, self.capacity),
            count=target,
            key=belief.key,
            step=belief.step + 1,
            ess_share=ess / belief.count,
            last=cloud.mean[..., : 2 * d],
            memory=memory,
            batch_size=key.shape,
        )
        return after, estimate

    def mean(self, belief: ParticleBelief) -> Float32[Tensor, "B N S"]:
        return moments(self.process, belief.particles, belief.log_weights.exp()).mean

    def moved(self, belief: ParticleBelief, offset: Float[Tensor, "B N d"]) -> ParticleBelief:
        d, offset = self.process.dim, offset.to(torch.float32)
        particles = belief.particles
        places = particles[..., :d] + offset.unsqueeze(-2)
        last = torch.cat((belief.last[..., :d] + offset, belief.last[..., d:]), -1)
        return belief.replace(particles=concat((places, particles[..., d:])), last=last)

    def diagnostics(self, belief: ParticleBelief) -> dict[str, Float[Tensor, "B N"]]:
        return {"particles": belief.count.to(torch.float32), "ess_share": belief.ess_share}

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
        return min(self.capacity, int(count.max()) + population.GROW)

    def _foresee(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        u: Float32[Tensor, "B N 1 U"],
        dt: Float32[Tensor, "B N 1"],
        draws: Float32[Tensor, "B N M W"],
        now: _Step,
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"], Bool[Tensor, "B N"]]:
        """Each particle moves with its own draw of the motion's noise, and meets the evidence;
        whether that leaves too few."""
        particles = self.process.propagate(particles, u, dt, draws)
        gain = self._evidence(particles, log_weights, now)
        return particles, gain, self._short(log_weights + gain, now)

    def _short(self, log_weights: Float32[Tensor, "B N M"], now: _Step) -> Bool[Tensor, "B N"]:
        """Whether weights are those of too few particles."""
        share = torch.where(now.belief.step < _START_STEPS, RESAMPLE, _RESCUE)
        return effective_sample_size(log_weights) < share * now.belief.count

    def _guide(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        now: _Step,
    ) -> _Guide:
        """A Gaussian update at the moments of the predicted cloud."""
        cloud = moments(self.process, particles, log_weights.exp())
        covariance = cloud.covariance + torch.diag(
            self.renewal.floor.to(cloud.covariance.device) ** 2
        )
        prior = Prediction(cloud.mean.double(), covariance, now.observation, now.belief.memory)
        linearize = linearizer(self.process, self.models, now.observation, now.neighbours)
        return _Guide(prior, iterated_update(prior, linearize, self.screen, _ITERATIONS))

    def _drawn(
        self, guide: _Guide, now: _Step, slots: int
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"]]:
        """Particles from 1.1 × the guide's posterior, with the log-weights that make them stand for
        its prior: log N(x; prior) − log N(x; drawn from)."""
        draws = normal(now.key, "pf.propose", self.process.error_size, slots)
        root = torch.linalg.cholesky_ex(_WIDEN * guide.found.covariance).L
        delta = (root.to(draws.dtype) @ draws.mT).mT
        centre = guide.found.state.to(draws.dtype).unsqueeze(-2)
        particles = self.process.boxplus(centre, delta)
        mean = guide.prior.state.to(draws.dtype).unsqueeze(-2)
        away = self.process.boxminus(particles, mean).double()
        root = torch.linalg.cholesky_ex(guide.prior.covariance).L
        scaled = torch.linalg.solve_triangular(root, away.mT, upper=False)
        ratio = 0.5 * (draws.double().square().sum(-1) - scaled.square().sum(-2))
        live = population.alive(now.belief.count, slots)
        return particles, normalized(torch.where(live, ratio, -torch.inf).to(draws.dtype))

    def _rescued(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        gain: Float32[Tensor, "B N M"],
        short: Bool[Tensor, "B N"],
        guide: _Guide | None,
        now: _Step,
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"]]:
        """Particles and unnormalized log-weights where the evidence would leave too few: in the
        first steps used in stages with a resampling move after each; later, or where a screen has a
        guide at hand, on particles drawn anew. A UAV that needs neither is not touched."""
        late = short if self.screen.judges else short & (now.belief.step >= _START_STEPS)
        early = short & ~late
        if bool(late.any()):
            guide = guide or self._guide(particles, log_weights, now)
            drawn, ratio = self._drawn(guide, now, particles.shape[-2])
            particles = torch.where(late[..., None, None], drawn, particles)
            log_weights = torch.where(late.unsqueeze(-1), ratio, log_weights)
            again = self._evidence(particles, log_weights, now)
            gain = torch.where(late.unsqueeze(-1), again, gain)
            # Evidence that even they cannot follow is left to the guide: its posterior, as drawn.
            lost = (late & self._short(log_weights + gain, now)).unsqueeze(-1)
            equal = population.equal_log_weights(log_weights > -torch.inf)
            log_weights = torch.where(lost, equal, log_weights)
            gain = gain.masked_fill(lost, 0.0)
        if bool(early.any()):
            return self._tempered(particles, log_weights, gain, early, now)
        return particles, log_weights + gain

    def _tempered(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        gain: Float32[Tensor, "B N M"],
        staged: Bool[Tensor, "B N"],
        now: _Step,
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"]]:
        """The evidence in stages for some UAVs, at once for the others."""
        count = now.belief.count
        equal = population.equal_log_weights(population.alive(count, particles.shape[-2]))
        left = torch.ones_like(gain[..., 0])
        for stage in range(_STAGES):
            share = left
            if stage < _STAGES - 1:
                some = increment(log_weights, gain, left, RESAMPLE * count)
                share = torch.where(staged, some, left)
            used = normalized(log_weights + share.unsqueeze(-1) * gain)
            log_weights = torch.where((left > 0).unsqueeze(-1), used, log_weights)
            left = left - share
            go_on = left > 0
            if not bool(go_on.any()):
                break
            weights = log_weights.exp()
            key = noise.fold(now.key, stage)
            draws = normal(key, "pf.move", self.process.error_size, weights.shape[-1])
            moved = self.renewal.resample(
                moments(self.process, particles, weights), weights, count, draws, key
            )
            particles = torch.where(go_on[..., None, None], moved, particles)
            log_weights = torch.where(go_on.unsqueeze(-1), equal, log_weights)
            gain = self._evidence(particles, log_weights, now)
        return particles, log_weights

    def _evidence(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        now: _Step,
    ) -> Float32[Tensor, "B N M"]:
        """What the step says of each particle: log-likelihood and learned correction."""
        centre = select(particles, log_weights.argmax(-1, keepdim=True))[..., 0, :]
        gain = log_likelihood(
            self.models,
            self.process,
            particles,
            centre,
            now.observation,
            now.neighbours,
            now.trusts,
        )
        correction = self.log_correction(particles, now.belief)
        return gain if correction is None else gain + correction


@register("pf500")
class Pf500(ParticleFilter):
    """SIR particle filter with 500 particles per UAV."""

    name = "pf500"

    def __init__(self, believed: Believed, *, particles: int = 500, **options: Any) -> None:
        super().__init__(believed, particles=particles, **options)


@register("pf800")
class Pf800(ParticleFilter):
    """SIR particle filter with 800 particles per UAV."""

    name = "pf800"

    def __init__(self, believed: Believed, *, particles: int = 800, **options: Any) -> None:
        super().__init__(believed, particles=particles, **options)


@register("apf")
class AdaptiveParticleFilter(ParticleFilter):
    """SIR particle filter that adapts its number of particles (PF-NN paper, without network).

    It starts with ``particles`` and stays within ``bounds``: 100 more where the effective sample
    size falls below 0.3 of the count, 50 fewer where it exceeds 0.8.
    """

    name = "apf"

    def __init__(
        self,
        believed: Believed,
        *,
        particles: int = 300,
        bounds: tuple[int, int] | None = (100, 800),
        **options: Any,
    ) -> None:
        super().__init__(believed, particles=particles, bounds=bounds, **options)
