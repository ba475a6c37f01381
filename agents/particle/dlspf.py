"""Deep latent-space particle filter (Mücke, Bohté & Oosterlee 2024), for UAVs."""

import torch
from jaxtyping import Bool, Float, Float32, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.errors import NotServed
from agents.kalman.filter import elapsed
from agents.localizer import Estimate, Localizer
from agents.models.measurements import Neighbours, make_measurements, no_neighbours, received
from agents.models.process import Process, make_process
from agents.particle import particle_count, sampling
from agents.particle.belief import normal, own_keys
from agents.particle.cloud import moments, normalized, select
from agents.particle.degeneracy import degenerate
from agents.particle.filter import Particles
from agents.particle.latent import WINDOW, LatentModel, unaccelerated
from agents.particle.likelihood import log_likelihood
from agents.particle.resampling import FLOOR, Resampling, per_error
from agents.particle.tempering import tempered
from agents.robust import Trust
from agents.tensorclasses import build
from agents.weights import learned
from coloc_env import noise
from coloc_env.geometry import concat
from coloc_env.observation import Observation
from coloc_env.options import Count
from coloc_env.scenario import Believed


class LatentBelief(TensorClass):
    """A reference state, particles beside it with normalized log-weights (latent state of position
    and velocity, then the remaining errors: attitude in rad, biases), the UAV's own random key,
    steps taken, and the last effective sample size as a share; batch (B, N)."""

    reference: Float32[Tensor, "B N S"]
    particles: Float32[Tensor, "B N M L"]
    log_weights: Float32[Tensor, "B N M"]
    key: Int64[Tensor, "B N"]
    step: Int64[Tensor, "B N"]
    ess_share: Float32[Tensor, "B N"]


class LatentSpace:
    """Latent states and remaining errors beside a reference: a linear space."""

    def __init__(self, process: Process, latents: int) -> None:
        self.latents, self.noise_size = latents, process.noise_size
        self.error_size = latents + process.error_size - 2 * process.dim

    def boxplus(
        self, x: Float[Tensor, "*s L"], delta: Float[Tensor, "*s L"]
    ) -> Float[Tensor, "*s L"]:
        return x + delta

    def boxminus(self, x: Float[Tensor, "*s L"], y: Float[Tensor, "*s L"]) -> Float[Tensor, "*s L"]:
        return x - y


class LatentParticleFilter(Localizer[LatentBelief]):
    """Particle filter whose particles are latent states of a Wasserstein auto-encoder of the last
    eight positions and velocities; a learned step moves them, driven by the IMU.

    A particle is weighed by the likelihood of the state that it decodes to. What is no part of a
    window (attitude, IMU biases) is carried beside the latent state, and moves as in ``pf500``, as
    do tempering and Liu–West moves after resampling; nothing is redrawn from an EKF. A motion model
    in space that estimates velocity is needed. ``weights``: a checkpoint's name or path,
    or none.
    """

    name = "dlspf"

    def __init__(
        self,
        believed: Believed,
        *,
        particles: Particles = 500,
        weights: str = "dlspf",
        seed: Count = 0,
        cooperate: bool = True,
    ) -> None:
        super().__init__(believed)
        self.process = make_process(believed)
        d = self.process.dim
        turns = self.process.attitude_error
        if d != 3 or self.process.error_size < 2 * d or (turns and turns.start != 2 * d):
            raise NotServed("a motion model in space that estimates velocity is needed")
        self.capacity, self.seed = particles, seed
        self.models = [m for m in make_measurements(believed) if cooperate or not m.cooperative]
        self.model = learned(LatentModel, weights, seed)
        self.length = WINDOW * self.process.dt  # T, s
        self.space = LatentSpace(self.process, self.model.latents)
        latent = [FLOOR["position"]] * self.model.latents  # z has unit variance for windows of 1 m
        floor = latent + per_error(self.process, FLOOR)[2 * d :]
        self.resampling = Resampling(self.space, floor, None)

    @torch.no_grad()
    def reset(self, observation: Observation) -> LatentBelief:
        mean, covariance = self.process.initial(observation["prior"])
        key, m = own_keys(observation, self.seed), self.capacity
        states = sampling.from_prior(self.process, self.believed, mean, covariance, key, m)
        equal = self._equal_log_weights(key)
        reference = moments(self.process, states, equal.exp()).mean
        return LatentBelief(
            reference=reference,
            particles=self._at_rest(states, reference),
            log_weights=equal,
            key=key,
            step=torch.zeros_like(key),
            ess_share=torch.ones_like(equal[..., 0]),
            batch_size=key.shape,
        )

    @torch.no_grad()
    def step(self, belief: LatentBelief, observation: Observation) -> tuple[LatentBelief, Estimate]:
        key = noise.fold(belief.key, belief.step)
        neighbours = no_neighbours(belief.reference[..., : self.process.dim])
        if any(model.cooperative for model in self.models):
            neighbours = received(self.believed, observation)
        reference, particles = self._predicted(belief, observation, key)
        log_weights, count = belief.log_weights, torch.full_like(key, self.capacity)
        if self.models:

            def evidence(particles: Tensor, log_weights: Tensor) -> Tensor:
                return self._evidence(reference, particles, log_weights, observation, neighbours)

            gain = evidence(particles, log_weights)
            few = degenerate(log_weights + gain, count, belief.step)
            if bool(few.any()):
                particles, log_weights = tempered(
                    particles, log_weights, gain, few, evidence, self.resampling, count, key
                )
            else:
                log_weights = normalized(log_weights + gain)
        weighed = self.resampling.weigh(particles, log_weights, count)
        windows = self._windows(particles)
        states = self._beside(reference, windows[..., -1, :], particles)
        cloud = moments(self.process, states, weighed.weights)
        scaled = weighed.weights.double()[..., None, None] * windows  # float64, as in ``moments``
        window = scaled.sum(-3, keepdim=True).to(windows.dtype)  # Σ w D(z)
        particles, log_weights = self.resampling.next_particles(particles, weighed, count, key)
        after = build(
            LatentBelief,
            key.shape,
            reference=cloud.mean,
            particles=self._about(cloud.mean, window, reference, particles),
            log_weights=log_weights,
            key=belief.key,
            step=belief.step + 1,
            ess_share=weighed.ess / self.capacity,
        )
        d = self.process.dim
        least = torch.eye(d, dtype=torch.float64, device=key.device) * FLOOR["position"] ** 2
        estimate = build(
            Estimate,
            key.shape,
            position=cloud.mean[..., :d],
            velocity=cloud.mean[..., d : 2 * d],
            covariance=cloud.covariance[..., :d, :d] + least,
        )
        return after, estimate

    def mean(self, belief: LatentBelief) -> Float32[Tensor, "B N S"]:
        return belief.reference

    def shifted(self, belief: LatentBelief, offset: Float[Tensor, "B N d"]) -> LatentBelief:
        d, x = self.process.dim, belief.reference
        return belief.replace(reference=torch.cat((x[..., :d] + offset.to(x), x[..., d:]), -1))

    @torch.no_grad()
    def restart_from(
        self,
        belief: LatentBelief,
        rows: Bool[Tensor, "B N"],
        state: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N E E"],
    ) -> LatentBelief:
        key, row = noise.fold(belief.key, belief.step), rows.unsqueeze(-1)
        draws = normal(key, "dlspf.restart", self.process.error_size, self.capacity)
        state = state.to(torch.float32)
        fresh = self._at_rest(sampling.gaussian(self.process, state, covariance, draws), state)
        equal = self._equal_log_weights(key)
        return belief.replace(
            reference=torch.where(row, state, belief.reference),
            particles=torch.where(row.unsqueeze(-1), fresh, belief.particles),
            log_weights=torch.where(row, equal, belief.log_weights),
        )

    def diagnostics(self, belief: LatentBelief) -> dict[str, Float[Tensor, "B N"]]:
        own = {
            "particles": torch.full_like(belief.ess_share, self.capacity),
            "ess_share": belief.ess_share,
        }
        if any(model.cooperative for model in self.models):
            own["bytes"] = torch.full_like(belief.ess_share, 4.0 * 3 * self.process.dim)
        return own

    # ---------------------------------------------------------------- to latent states and back

    def _equal_log_weights(self, key: Int64[Tensor, "B N"]) -> Float32[Tensor, "B N M"]:
        count = torch.full_like(key, self.capacity)
        return particle_count.equal_log_weights(particle_count.alive(count, self.capacity))

    def _newest(self, error: Float32[Tensor, "B N M E"]) -> Float32[Tensor, "B N M 6"]:
        """[δp, T δv] of an error."""
        return torch.cat((error[..., :3], self.length * error[..., 3:6]), -1)

    def _at_rest(
        self, states: Float32[Tensor, "B N M S"], reference: Float32[Tensor, "B N S"]
    ) -> Float32[Tensor, "B N M L"]:
        """Particles of states of which no past is known: as if their velocity had stayed."""
        error = self.process.boxminus(states, reference.unsqueeze(-2).expand_as(states))
        z = self.model.encode(unaccelerated(self._newest(error)))
        return torch.cat((z, error[..., 6:]), -1)

    def _states(
        self, reference: Float32[Tensor, "B N S"], particles: Float32[Tensor, "B N M L"]
    ) -> Float32[Tensor, "B N M S"]:
        """x = x̄ ⊞ [D(z), rest]."""
        newest = self.model.newest(particles[..., : self.space.latents])
        return self._beside(reference, newest, particles)

    def _beside(
        self,
        reference: Float32[Tensor, "B N S"],
        newest: Float32[Tensor, "B N M 6"],
        particles: Float32[Tensor, "B N M L"],
    ) -> Float32[Tensor, "B N M S"]:
        """The same, decoded already."""
        rest = particles[..., self.space.latents :]
        delta = concat((newest[..., :3], newest[..., 3:] / self.length, rest))
        at = reference.unsqueeze(-2).expand(*particles.shape[:-1], -1)
        return self.process.boxplus(at, delta)

    def _about(
        self,
        mean: Float32[Tensor, "B N S"],
        window: Float32[Tensor, "B N 1 W 6"],
        reference: Float32[Tensor, "B N S"],
        particles: Float32[Tensor, "B N M L"],
    ) -> Float32[Tensor, "B N M L"]:
        """Particles beside the mean, the new reference: windows less the mean, encoded again."""
        windows = self._windows(particles)
        states = self._beside(reference, windows[..., -1, :], particles)
        error = self.process.boxminus(states, mean.unsqueeze(-2).expand_as(states))
        z = self.model.encode(windows - window)
        return torch.cat((z, error[..., 6:]), -1)

    def _windows(self, particles: Float32[Tensor, "B N M L"]) -> Float32[Tensor, "B N M W 6"]:
        decoded: Tensor = self.model.decode(particles[..., : self.space.latents])
        return decoded

    # ---------------------------------------------------------------- prediction and update

    def _predicted(
        self, belief: LatentBelief, observation: Observation, key: Int64[Tensor, "B N"]
    ) -> tuple[Float32[Tensor, "B N S"], Float32[Tensor, "B N M L"]]:
        """z' = F(z, T δu), δu = (v' − v) − (v̄' − v̄): what a particle's velocity gains by the IMU's
        increment in its own attitude, with its own draw of noise, beside what the reference gains.
        """
        u = self.process.inputs(observation).to(torch.float32)
        dt = elapsed(self.process, belief.step).to(torch.float32)
        draws = normal(key, "pf.step", self.process.noise_size, self.capacity)
        before = self._states(belief.reference, belief.particles)
        after = self.process.propagate(before, u.unsqueeze(-2), dt.unsqueeze(-1), draws)
        reference = self.process.propagate(belief.reference, u, dt)
        gained = (reference - belief.reference)[..., None, 3:6]
        push = self.length * ((after - before)[..., 3:6] - gained)
        z = belief.particles[..., : self.space.latents]
        moving = (belief.step > 0)[..., None, None]
        z = torch.where(moving, self.model.advance(z, push), z)
        rest = self.process.boxminus(after, reference.unsqueeze(-2).expand_as(after))[..., 6:]
        return reference, torch.cat((z, rest), -1)

    def _evidence(
        self,
        reference: Float32[Tensor, "B N S"],
        particles: Float32[Tensor, "B N M L"],
        log_weights: Float32[Tensor, "B N M"],
        observation: Observation,
        neighbours: Neighbours,
    ) -> Float32[Tensor, "B N M"]:
        """Log-likelihood of the states that particles decode to."""
        states = self._states(reference, particles)
        heaviest = log_weights.argmax(-1, keepdim=True)
        centre = select(states, heaviest)[..., 0, :]
        trusts = [Trust()] * len(self.models)
        evidence = observation, neighbours, trusts
        return log_likelihood(self.models, self.process, states, centre, *evidence)
