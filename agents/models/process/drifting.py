"""Any motion model beside the bias of a sensor that drifts."""

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.process.base import LEAST_STD, Process
from agents.models.rotations import concat
from coloc_env.observation import Observation
from coloc_env.sensors import Height


class DriftingProcess(Process):
    """x = [motion, b]: the states of another motion model and, last, the bias of heights in m, a
    stationary Gauss–Markov process: b' = φ b + √(1 − φ²) σ_b w, φ = exp(−dt / τ).

    A bias that lasts is worth estimating: heights that a filter takes as if they had none would
    cost more than they give.
    """

    drift_size = 1

    def __init__(self, motion: Process, height: Height) -> None:
        super().__init__(motion.dim, motion.dt)
        self.motion, self.time = motion, height.bias_time
        self.std = max(height.bias_std, LEAST_STD)
        self.state_size, self.error_size = motion.state_size + 1, motion.error_size + 1
        self.noise_size, self.attitude_size = motion.noise_size + 1, motion.attitude_size
        self.attitude_error = motion.attitude_error

    def inputs(self, observation: Observation) -> Float[Tensor, "B N U"]:
        return self.motion.inputs(observation)

    def _kept(self, dt: Float[Tensor, "*s"]) -> Float[Tensor, "*s 1"]:
        """φ."""
        return (-dt / self.time).exp().unsqueeze(-1)

    def propagate(
        self,
        x: Float[Tensor, "*s S"],
        u: Float[Tensor, "*s U"],
        dt: Float[Tensor, "*s"],
        noise: Float[Tensor, "*s W"] | None = None,
    ) -> Float[Tensor, "*s S"]:
        kept, own = self._kept(dt), None if noise is None else noise[..., :-1]
        bias = kept * x[..., -1:]
        if noise is not None:
            bias = bias + (1 - kept**2).sqrt() * self.std * noise[..., -1:]
        return concat((self.motion.propagate(x[..., :-1], u, dt, own), bias))

    def retreat(
        self, x: Float[Tensor, "*s S"], u: Float[Tensor, "*s U"], dt: Float[Tensor, "*s"]
    ) -> Float[Tensor, "*s S"]:
        return concat((self.motion.retreat(x[..., :-1], u, dt), x[..., -1:] / self._kept(dt)))

    def linearize(
        self, x: Float[Tensor, "*s S"], u: Float[Tensor, "*s U"], dt: Float[Tensor, "*s"]
    ) -> tuple[Float[Tensor, "*s E E"], Float[Tensor, "*s E E"]]:
        f, q = (
            torch.nn.functional.pad(part, (0, 1, 0, 1))
            for part in self.motion.linearize(x[..., :-1], u, dt)
        )
        kept = self._kept(dt)[..., 0].to(f.dtype)
        f[..., -1, -1], q[..., -1, -1] = kept, (1 - kept**2) * self.std**2
        return f, q

    def initial(
        self, prior: Float[Tensor, "*s W"]
    ) -> tuple[Float[Tensor, "*s S"], Float[Tensor, "*s E E"]]:
        mean, covariance = self.motion.initial(prior)
        covariance = torch.nn.functional.pad(covariance, (0, 1, 0, 1))
        covariance[..., -1, -1] = self.std**2
        return torch.nn.functional.pad(mean, (0, 1)), covariance

    def boxplus(
        self, x: Float[Tensor, "*s S"], delta: Float[Tensor, "*s E"]
    ) -> Float[Tensor, "*s S"]:
        moved = self.motion.boxplus(x[..., :-1], delta[..., :-1])
        return concat((moved, x[..., -1:] + delta[..., -1:]))

    def boxminus(self, x: Float[Tensor, "*s S"], y: Float[Tensor, "*s S"]) -> Float[Tensor, "*s E"]:
        moved = self.motion.boxminus(x[..., :-1], y[..., :-1])
        return concat((moved, x[..., -1:] - y[..., -1:]))
