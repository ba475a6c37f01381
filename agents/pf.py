"""SIR particle filters with Liu-West regularization and adaptive tempering, one per UAV.

Gordon, Salmond & Smith 1993; resampling when the effective sample size falls below half.
Neighbours' messages enter as ranges whose variance is inflated by the sender's own uncertainty.
"""

import math
from typing import Literal

import torch
from jaxtyping import Float, Float32, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.ekf import elapsed
from agents.localizer import Estimate, Localizer, register
from agents.models.measurements import heard, make_measurements
from agents.models.process import Process, make_process
from agents.particles.cloud import (
    effective_sample_size,
    liu_west,
    moments,
    select,
    systematic,
    weighted_covariance,
)
from agents.particles.likelihood import log_likelihood
from agents.particles.tempering import increment
from coloc_env import noise
from coloc_env.geometry import concat
from coloc_env.observation import Observation
from coloc_env.scenario import Believed

Perturb = Literal["liu_west", "fixed"]

# Standard deviations that keep a resampled cloud from collapsing (specs: Liu-West's floor, and the
# smallest fixed perturbation that loses no UAV): m, m/s, rad, m/s², rad/s.
_FLOOR = {"position": 0.005, "velocity": 0.005, "attitude": 0.0015, "accel": 0.002, "gyro": 0.0002}
_FIXED = {"position": 0.03, "velocity": 0.03, "attitude": 0.01, "accel": 0.01, "gyro": 0.001}
_RESAMPLE = 0.5  # share of M below which the effective sample size triggers resampling
_START_STEPS = 3  # steps in which the likelihood is tempered down to that share
_RESCUE = 0.1  # the share below which it is tempered later
_STAGES = 40  # more than any likelihood has needed


class ParticleBelief(TensorClass):
    """Particles (float32) with normalized log-weights, the UAV's own random key, steps taken, and
    the last effective sample size; batch (B, N)."""

    particles: Float32[Tensor, "B N M S"]
    log_weights: Float32[Tensor, "B N M"]
    key: Int64[Tensor, "B N"]
    step: Int64[Tensor, "B N"]
    ess: Float32[Tensor, "B N"]


def own_keys(observation: Observation, seed: int) -> Int64[Tensor, "B N"]:
    """One random key per UAV, from what its prior says and the localizer's seed: the same UAV in
    the same world draws the same numbers in any batch, team subset or face."""
    bits = observation["prior"].contiguous().view(torch.int32).to(torch.int64)
    index = torch.arange(bits.shape[-1], device=bits.device)
    return noise.fold(noise.fold(bits, index).sum(-1), seed)


class ParticleFilter(Localizer[ParticleBelief]):
    """Bootstrap filter with a fixed number of particles.

    ``perturb``: ``liu_west`` moves resampled particles so that the cloud keeps its moments, above a
    small floor; ``fixed`` adds N(0, Σ_perturb) instead (the paper's way). ``tempering=false`` uses
    every likelihood at once, however few particles survive it.
    """

    name = "pf"

    def __init__(
        self,
        believed: Believed,
        particles: int,
        seed: int,
        perturb: Perturb,
        tempering: bool,
        cooperate: bool,
    ) -> None:
        super().__init__(believed)
        if particles < 10:
            raise ValueError(f"particles={particles} is not allowed: at least 10")
        self.particles, self.seed, self.tempering = particles, seed, tempering
        self.process = make_process(believed)
        self.models = [m for m in make_measurements(believed) if cooperate or not m.cooperative]
        self.shrink, std = (0.7, _FLOOR) if perturb == "liu_west" else (0.0, _FIXED)
        self.floor = torch.tensor(_per_error(self.process, std))

    def reset(self, observation: Observation) -> ParticleBelief:
        prior = observation["prior"]
        mean, covariance = self.process.initial(prior)
        key = own_keys(observation, self.seed)
        e, m, d = self.process.error_size, self.particles, self.process.dim
        draws = noise.normal(key, "pf.reset", m * e).unflatten(-1, (e, m)).mT
        delta = draws * covariance.diagonal(dim1=-2, dim2=-1).sqrt().unsqueeze(-2)
        particles = self.process.boxplus(mean.unsqueeze(-2).expand(-1, -1, m, -1), delta)
        if self.believed.prior.kind == "uniform":
            arena = self.believed.arena
            low, high = (prior.new_tensor(x) for x in (arena.low, arena.high))
            place = noise.uniform(key, "pf.place", m * d).unflatten(-1, (d, m)).mT
            particles = concat((low + place * (high - low), particles[..., d:]))
        return ParticleBelief(
            particles=particles,
            log_weights=torch.full_like(particles[..., 0], -math.log(m)),
            key=key,
            step=torch.zeros_like(key),
            ess=torch.full_like(prior[..., 0], float(m)),
            batch_size=key.shape,
        )

    def step(
        self, belief: ParticleBelief, observation: Observation
    ) -> tuple[ParticleBelief, Estimate]:
        key = noise.fold(belief.key, belief.step)
        particles = self._predict(belief, observation, key)
        particles, log_weights = self._weigh(
            particles, belief.log_weights, belief.step, observation, key
        )
        weights, ess = log_weights.exp(), effective_sample_size(log_weights)
        mean, apart = moments(self.process, particles, weights)
        covariance = weighted_covariance(apart, weights)
        d = self.process.dim
        least = torch.eye(d, device=key.device) * _FLOOR["position"] ** 2
        estimate = Estimate(
            position=mean[..., :d],
            velocity=mean[..., d : 2 * d],
            covariance=covariance[..., :d, :d] + least,
            batch_size=key.shape,
        )
        few = ess < _RESAMPLE * self.particles
        moved = self._resample(mean, apart, covariance, weights, noise.fold(key, _STAGES))
        after = ParticleBelief(
            particles=torch.where(few[..., None, None], moved, particles),
            log_weights=log_weights.masked_fill(few[..., None], -math.log(self.particles)),
            key=belief.key,
            step=belief.step + 1,
            ess=ess,
            batch_size=key.shape,
        )
        return after, estimate

    def diagnostics(self, belief: ParticleBelief) -> dict[str, Float[Tensor, "B N"]]:
        count = torch.full_like(belief.ess, float(self.particles))
        return {"particles": count, "ess_share": belief.ess / count}

    def _predict(
        self, belief: ParticleBelief, observation: Observation, key: Int64[Tensor, "B N"]
    ) -> Float32[Tensor, "B N M S"]:
        """Each particle moves with its own draw of the motion's noise."""
        m, w = self.particles, self.process.noise_size
        draws = noise.normal(key, "pf.predict", m * w).unflatten(-1, (w, m)).mT
        u = self.process.inputs(observation).to(torch.float32).unsqueeze(-2)
        dt = elapsed(self.process, belief.step).to(torch.float32).unsqueeze(-1)
        return self.process.propagate(belief.particles, u, dt, draws)

    def _weigh(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        step: Int64[Tensor, "B N"],
        observation: Observation,
        key: Int64[Tensor, "B N"],
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"]]:
        """Use the step's likelihood; where it would leave too few particles, in stages with a
        resampling move after each. A UAV that needs no stages is not touched by others that do."""
        neighbours = heard(self.believed, observation)

        def evidence() -> Float32[Tensor, "B N M"]:
            centre = select(particles, log_weights.argmax(-1, keepdim=True))[..., 0, :]
            return log_likelihood(
                self.models, self.process, particles, centre, observation, neighbours
            )

        gain = evidence()
        threshold = torch.where(step < _START_STEPS, _RESAMPLE, _RESCUE) * self.particles
        staged = effective_sample_size(log_weights + gain) < threshold
        if not (self.tempering and bool(staged.any())):
            return particles, (log_weights + gain).log_softmax(-1)
        left = torch.ones_like(gain[..., 0])
        for stage in range(_STAGES):
            share = left
            if stage < _STAGES - 1:
                share = torch.where(staged, increment(log_weights, gain, left, _RESAMPLE), left)
            used = (log_weights + share.unsqueeze(-1) * gain).log_softmax(-1)
            log_weights = torch.where((left > 0).unsqueeze(-1), used, log_weights)
            left = left - share
            go_on = left > 0
            if not bool(go_on.any()):
                break
            weights = log_weights.exp()
            mean, apart = moments(self.process, particles, weights)
            covariance = weighted_covariance(apart, weights)
            moved = self._resample(mean, apart, covariance, weights, noise.fold(key, stage))
            particles = torch.where(go_on[..., None, None], moved, particles)
            log_weights = torch.where(
                go_on[..., None], torch.full_like(gain, -math.log(self.particles)), log_weights
            )
            gain = evidence()
        return particles, log_weights

    def _resample(
        self,
        mean: Float32[Tensor, "B N S"],
        apart: Float32[Tensor, "B N M E"],
        covariance: Float32[Tensor, "B N E E"],
        weights: Float32[Tensor, "B N M"],
        key: Int64[Tensor, "B N"],
    ) -> Float32[Tensor, "B N M S"]:
        """Equally weighted particles drawn from the weighted ones, then moved apart."""
        m, e = self.particles, self.process.error_size
        ancestors = systematic(weights, noise.uniform(key, "pf.offset", 1)[..., 0])
        draws = noise.normal(key, "pf.move", m * e).unflatten(-1, (e, m)).mT
        floor = self.floor.to(draws.device)
        return liu_west(
            self.process, mean, select(apart, ancestors), covariance, draws, self.shrink, floor
        )


def _per_error(process: Process, std: dict[str, float]) -> list[float]:
    """A standard deviation for each component of the process's error."""
    d, turn = process.dim, process.attitude_error
    if turn is None:
        return [std["position"]] * d + [std["velocity"]] * d
    linear = [std["position"]] * d + [std["velocity"]] * (turn.start - d)
    biases = [std["accel"]] * 3 + [std["gyro"]] * 3
    return (linear + [std["attitude"]] * (turn.stop - turn.start) + biases)[: process.error_size]


def _register(size: int) -> None:
    @register(f"pf{size}")
    def particle_filter(
        believed: Believed,
        *,
        particles: int = size,
        seed: int = 0,
        perturb: Perturb = "liu_west",
        tempering: bool = True,
        cooperate: bool = True,
    ) -> ParticleFilter:
        return ParticleFilter(believed, particles, seed, perturb, tempering, cooperate)

    particle_filter.__doc__ = f"SIR particle filter with {size} particles per UAV."


_register(500)
_register(800)
