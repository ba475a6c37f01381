"""From a weighted cloud to the next step's particles: moments, resampling, counts that adapt."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from agents.models.process import Process
from agents.particle import particle_count
from agents.particle.belief import normal
from agents.particle.cloud import Manifold, Moments, liu_west, moments, normalized, systematic
from coloc_env import noise

Perturb = Literal["liu_west", "fixed"]
SHRINKAGE = 0.7  # h of Liu–West moves
RESAMPLE = 0.5  # share of the count below which the effective sample size triggers resampling

# Standard deviations that keep a resampled cloud from collapsing (specs: Liu-West's floor, and the
# smallest fixed perturbation that loses no UAV): m, m/s, rad, m/s², rad/s.
FLOOR = {"position": 0.005, "velocity": 0.005, "attitude": 0.0015, "accel": 0.002, "gyro": 0.0002}
_FIXED = {"position": 0.03, "velocity": 0.03, "attitude": 0.01, "accel": 0.01, "gyro": 0.001}


@dataclass(frozen=True)
class Weighed:
    """A cloud after the evidence: normalized weights and their logarithms, moments, effective
    sample size, and how many particles the next step gets."""

    log_weights: Float32[Tensor, "B N M"]
    weights: Float32[Tensor, "B N M"]
    cloud: Moments
    ess: Float32[Tensor, "B N"]
    target: Int64[Tensor, "B N"]


class Resampling:
    """PF-NN paper's Algorithm 2, with counts within ``bounds`` (None: they stay as they are), whose
    moves are Liu–West's with h = ``shrinkage`` above a floor of standard deviations ``std``."""

    def __init__(
        self,
        space: Manifold,
        std: Sequence[float],
        bounds: tuple[int, int] | None,
        shrinkage: float = SHRINKAGE,
    ) -> None:
        self.space, self.bounds, self.shrinkage = space, bounds, shrinkage
        self.floor = torch.tensor(std, dtype=torch.float64)

    @staticmethod
    def of(process: Process, perturb: Perturb, bounds: tuple[int, int] | None) -> "Resampling":
        """Of a motion model's states, moved apart as ``perturb`` says."""
        if perturb == "liu_west":
            return Resampling(process, per_error(process, FLOOR), bounds)
        return Resampling(process, per_error(process, _FIXED), bounds, 0.0)

    def weigh(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        count: Int64[Tensor, "B N"],
    ) -> Weighed:
        """Algorithm 2's first part: moments, effective sample size, and the count adapted to it."""
        exact = log_weights.double().log_softmax(-1)
        ess = (1 / (2 * exact).exp_().sum(-1)).to(log_weights.dtype)
        log_weights = exact.to(log_weights.dtype)
        weights = log_weights.exp()
        cloud = moments(self.space, particles, weights)
        target = count if self.bounds is None else particle_count.adapted(count, ess, self.bounds)
        return Weighed(log_weights, weights, cloud, ess, target)

    def next_particles(
        self,
        particles: Float32[Tensor, "B N M S"],
        weighed: Weighed,
        count: Int64[Tensor, "B N"],
        key: Int64[Tensor, "B N"],
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"]]:
        """The rest of Algorithm 2: the next step's particles and normalized log-weights, resampled
        where few are effective, and as many as their count has become."""
        log_weights = weighed.log_weights
        if bool(self.few(weighed, count).any()):
            size, first = self.space.error_size, self.space.noise_size
            draws = normal(key, "pf.step", size, particles.shape[-2], first)
            particles, log_weights = self.resample_few(particles, weighed, count, draws, key)
        particles, log_weights = self.shrink(particles, log_weights, weighed, count)
        return self.gathered(particles, weighed), log_weights

    def resample_few(
        self,
        particles: Float32[Tensor, "B N M S"],
        weighed: Weighed,
        count: Int64[Tensor, "B N"],
        draws: Float32[Tensor, "B N M E"],
        key: Int64[Tensor, "B N"],
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"]]:
        """Algorithm 2 but for shrinking: resampling where the effective sample size is low."""
        few = self.few(weighed, count)
        moved = self.resample(weighed.cloud, weighed.weights, weighed.target, draws, key)
        live = particle_count.alive(torch.maximum(count, weighed.target), particles.shape[-2])
        particles = torch.where(few[..., None, None], moved, particles)
        equal = particle_count.equal_log_weights(live)
        log_weights = torch.where(few.unsqueeze(-1), equal, weighed.log_weights)
        return particles, log_weights

    def estimated(
        self,
        weighed: Weighed,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
    ) -> Moments:
        """The cloud that the step's estimate is made of: the weighted one, before resampling."""
        return weighed.cloud

    @staticmethod
    def few(weighed: Weighed, count: Int64[Tensor, "B N"]) -> Bool[Tensor, "B N"]:
        """Whose effective sample size is low."""
        return weighed.ess < RESAMPLE * count.to(torch.float32)

    def shrink(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        weighed: Weighed,
        count: Int64[Tensor, "B N"],
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"]]:
        """Algorithm 2, shrinking: the heaviest stay where the count has fallen."""
        target = weighed.target
        fewer = target < count
        if self.bounds is None or not bool(fewer.any()):
            return particles, log_weights
        particles, kept = particle_count.heaviest_first(particles, log_weights, fewer)
        live = particle_count.alive(target, particles.shape[-2])
        kept = normalized(kept.masked_fill(~live, -torch.inf))
        log_weights = torch.where(fewer.unsqueeze(-1), kept, log_weights)
        return particles, log_weights

    def resample(
        self,
        cloud: Moments,
        weights: Float32[Tensor, "B N M"],
        count: Int64[Tensor, "B N"],
        draws: Float32[Tensor, "B N M E"],
        key: Int64[Tensor, "B N"],
    ) -> Float32[Tensor, "B N M S"]:
        """Equally weighted particles drawn from the weighted ones, then moved apart."""
        ancestors = systematic(weights, noise.unit(key), count)
        floor = self.floor.to(draws.device)
        return liu_west(self.space, cloud, ancestors, draws, self.shrinkage, floor)

    def gathered(
        self, particles: Float32[Tensor, "B N M S"], weighed: Weighed
    ) -> Float32[Tensor, "B N M S"]:
        """Dead particles all at the mean, whatever they were."""
        if self.bounds is None:
            return particles
        live = particle_count.alive(weighed.target, particles.shape[-2])
        return torch.where(live.unsqueeze(-1), particles, weighed.cloud.mean.unsqueeze(-2))


def padded_weights(log_weights: Float32[Tensor, "B N m"], slots: int) -> Float32[Tensor, "B N M"]:
    """With slots of dead particles at the end."""
    missing = slots - log_weights.shape[-1]
    if not missing:
        return log_weights
    return torch.nn.functional.pad(log_weights, (0, missing), value=-torch.inf)


def padded(
    particles: Float32[Tensor, "B N m S"], mean: Float32[Tensor, "B N S"], slots: int
) -> Float32[Tensor, "B N M S"]:
    """With slots of dead particles, which are at the mean, at the end."""
    missing = slots - particles.shape[-2]
    if not missing:
        return particles
    rest = mean.unsqueeze(-2).expand(*mean.shape[:-1], missing, mean.shape[-1])
    return torch.cat((particles.movedim(-1, 0), rest.movedim(-1, 0)), -1).movedim(0, -1)


def per_error(process: Process, std: dict[str, float]) -> list[float]:
    """A standard deviation for each component of the process's error."""
    d, turn = process.dim, process.attitude_error
    size, drift = process.error_size - process.drift_size, [std["position"]] * process.drift_size
    if turn is None:
        return ([std["position"]] * d + [std["velocity"]] * d)[:size] + drift
    linear = [std["position"]] * d + [std["velocity"]] * (turn.start - d)
    biases = [std["accel"]] * 3 + [std["gyro"]] * 3
    return (linear + [std["attitude"]] * (turn.stop - turn.start) + biases)[:size] + drift
