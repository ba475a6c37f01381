"""Velocity that only noise changes."""

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.process.base import Process
from agents.models.rotations import concat
from coloc_env import scenario as believed_processes
from coloc_env.observation import Observation


class ConstantVelocityProcess(Process):
    """x = [p, v]; white acceleration, and optionally a pull of the velocity to zero
    (Ornstein-Uhlenbeck, exactly discretized); or acceleration that is held over each step."""

    def __init__(self, dim: int, dt: float, settings: believed_processes.ConstantVelocity) -> None:
        super().__init__(dim, dt)
        self.settings = settings
        self.state_size = self.error_size = 2 * dim
        self.noise_size = dim if settings.held else 2 * dim

    def inputs(self, observation: Observation) -> Float[Tensor, "B N 0"]:
        return observation["prior"][..., :0].double()

    def _coefficients(self, dt: Float[Tensor, "*s"]) -> tuple[Tensor, ...]:
        """Decay of v, its part in p, and the variances (pp, pv, vv) that one step adds."""
        density, damping = self.settings.accel_std**2, self.settings.damping
        if damping is None:
            one = torch.ones_like(dt)
            if self.settings.held:
                return one, dt, density * dt**4 / 4, density * dt**3 / 2, density * dt**2
            return one, dt, density * dt**3 / 3, density * dt**2 / 2, density * dt
        r = dt.double() / damping
        once, twice = torch.expm1(-r), torch.expm1(-2 * r)
        # What is left of the terms that cancel, as a series where nothing would be left of them.
        series = 1 / 3 - r / 4 + 7 / 60 * r**2 - r**3 / 24
        share = torch.where(r < 0.01, series, (r + 2 * once - 0.5 * twice) / r**3)
        carry = -damping * once
        pp, pv = density * dt**3 * share, density * carry**2 / 2
        vv = -density * damping / 2 * twice
        return tuple(c.to(dt) for c in (1 + once, carry, pp, pv, vv))

    def propagate(
        self,
        x: Float[Tensor, "*s S"],
        u: Float[Tensor, "*s 0"],
        dt: Float[Tensor, "*s"],
        noise: Float[Tensor, "*s W"] | None = None,
    ) -> Float[Tensor, "*s S"]:
        d = self.dim
        decay, carry, pp, pv, vv = (c.unsqueeze(-1) for c in self._coefficients(dt))
        p, v = x[..., :d] + carry * x[..., d:], decay * x[..., d:]
        if noise is not None:
            first = pp.sqrt()
            slope = torch.where(first > 0, pv / first.clamp_min(1e-30), torch.zeros_like(first))
            p, v = p + first * noise[..., :d], v + slope * noise[..., :d]
            if not self.settings.held:
                v = v + (vv - slope**2).clamp_min(0).sqrt() * noise[..., d:]
        return concat((p, v))

    def retreat(
        self, x: Float[Tensor, "*s S"], u: Float[Tensor, "*s 0"], dt: Float[Tensor, "*s"]
    ) -> Float[Tensor, "*s S"]:
        decay, carry, *_ = (c.unsqueeze(-1) for c in self._coefficients(dt))
        v = x[..., self.dim :] / decay
        return concat((x[..., : self.dim] - carry * v, v))

    def linearize(
        self, x: Float[Tensor, "*s S"], u: Float[Tensor, "*s 0"], dt: Float[Tensor, "*s"]
    ) -> tuple[Float[Tensor, "*s S S"], Float[Tensor, "*s S S"]]:
        d = self.dim
        decay, carry, pp, pv, vv = (c[..., None, None] for c in self._coefficients(dt))
        eye = torch.eye(d, dtype=x.dtype, device=x.device)
        zero = torch.zeros_like(carry)
        f = torch.cat(
            (
                torch.cat(((1 + zero) * eye, carry * eye), -1),
                torch.cat((zero * eye, decay * eye), -1),
            ),
            -2,
        )
        q = torch.cat(
            (torch.cat((pp * eye, pv * eye), -1), torch.cat((pv * eye, vv * eye), -1)), -2
        )
        return f, q
