"""Dead reckoning with a measured velocity or displacement, which is no estimated quantity."""

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models import rotations
from agents.models.process.base import Process
from agents.models.rotations import concat, rotate, rotate_by, rotation_between
from coloc_env import scenario as believed_processes
from coloc_env.observation import Observation
from coloc_env.sensors import Displacement, Ins, Odometry


class WheeledProcess(Process):
    """Planar dead reckoning: x = [p, v, θ], u = odometry [forward, left, turn] per second; where
    samples of a recording are missing u has the standard deviations of what they leave unknown
    behind it, which add to the noise: σ² + s².

    The velocity is the odometry's, not an estimated quantity: the error is [δp, δθ].
    """

    attitude_size = 1
    attitude_error = slice(2, 3)
    state_size, error_size, noise_size = 5, 3, 3

    def __init__(self, dt: float, odometry: Odometry) -> None:
        super().__init__(2, dt)
        self.odometry = odometry

    def _initial(
        self, mean: Float[Tensor, "*s 5"], std: Float[Tensor, "*s 5"]
    ) -> tuple[Float[Tensor, "*s 5"], Float[Tensor, "*s 3 3"]]:
        return mean, torch.diag_embed(std[..., [0, 1, 4]] ** 2)

    def inputs(self, observation: Observation) -> Float[Tensor, "B N U"]:
        odometry = observation["odometry"].double()
        if "odometry_unknown" not in observation:
            return odometry
        unknown = observation["odometry_unknown"].double().expand_as(odometry)
        return torch.cat((odometry, unknown), -1)

    def _std(self, u: Float[Tensor, "*s U"]) -> Float[Tensor, "*s 3"]:
        std, unknown = self.odometry.std(u[..., :3]), u[..., 3:]
        return torch.hypot(std, unknown) if unknown.shape[-1] else std

    def propagate(
        self,
        x: Float[Tensor, "*s 5"],
        u: Float[Tensor, "*s 3"],
        dt: Float[Tensor, "*s"],
        noise: Float[Tensor, "*s 3"] | None = None,
    ) -> Float[Tensor, "*s 5"]:
        if noise is not None:
            u = u[..., :3] + self._std(u) * noise
        dt = dt.unsqueeze(-1)
        velocity = rotate(x[..., 4:], u[..., :2])
        position = x[..., :2] + velocity * dt
        velocity = torch.where(dt > 0, velocity, x[..., 2:4])
        return concat((position, velocity, rotate_by(x[..., 4:], u[..., 2:3] * dt)))

    def retreat(
        self, x: Float[Tensor, "*s 5"], u: Float[Tensor, "*s 3"], dt: Float[Tensor, "*s"]
    ) -> Float[Tensor, "*s 5"]:
        dt = dt.unsqueeze(-1)
        heading = rotate_by(x[..., 4:], -u[..., 2:3] * dt)
        return concat((x[..., :2] - rotate(heading, u[..., :2]) * dt, x[..., 2:4], heading))

    def linearize(
        self, x: Float[Tensor, "*s 5"], u: Float[Tensor, "*s 3"], dt: Float[Tensor, "*s"]
    ) -> tuple[Float[Tensor, "*s 3 3"], Float[Tensor, "*s 3 3"]]:
        h = dt[..., None]
        rotation = rotations.matrix(x[..., 4:])
        forward = (rotation @ u[..., :2, None])[..., 0] * h
        f = torch.eye(3, dtype=x.dtype, device=x.device).expand(*x.shape[:-1], 3, 3).clone()
        f[..., 0, 2], f[..., 1, 2] = -forward[..., 1], forward[..., 0]
        variance = (self._std(u) * h) ** 2
        q = torch.zeros_like(f)
        q[..., :2, :2] = (rotation * variance[..., None, :2]) @ rotation.mT
        q[..., 2, 2] = variance[..., 2]
        return f, q

    def boxminus(self, x: Float[Tensor, "*s 5"], y: Float[Tensor, "*s 5"]) -> Float[Tensor, "*s 3"]:
        turn = rotation_between(y[..., 4:], x[..., 4:])
        return concat((x[..., :2] - y[..., :2], turn))

    def _linear(self, delta: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 4"]:
        return torch.cat((delta[..., :2], torch.zeros_like(delta[..., :2])), -1)


class PositionError(Process):
    """x = [p, v] whose velocity is given, not estimated: the error is δp."""

    def __init__(self, dim: int, dt: float) -> None:
        super().__init__(dim, dt)
        self.state_size, self.error_size, self.noise_size = 2 * dim, dim, dim

    def _initial(
        self, mean: Float[Tensor, "*s W"], std: Float[Tensor, "*s 2d"]
    ) -> tuple[Float[Tensor, "*s 2d"], Float[Tensor, "*s d d"]]:
        return mean[..., : self.state_size], torch.diag_embed(std[..., : self.dim] ** 2)

    def boxminus(
        self, x: Float[Tensor, "*s 2d"], y: Float[Tensor, "*s 2d"]
    ) -> Float[Tensor, "*s d"]:
        return x[..., : self.dim] - y[..., : self.dim]

    def _linear(self, delta: Float[Tensor, "*s d"]) -> Float[Tensor, "*s 2d"]:
        return torch.cat((delta, torch.zeros_like(delta)), -1)


class InsProcess(PositionError):
    """x = [p, v], u = the INS's velocity: p' = p + u dt, v' = u.

    The velocity is the INS's, not an estimated quantity: the error is δp.
    """

    def __init__(
        self, dim: int, dt: float, ins: Ins, settings: believed_processes.InsDriven
    ) -> None:
        super().__init__(dim, dt)
        self.std = (ins.std**2 + settings.bias_share * ins.bias**2) ** 0.5

    def inputs(self, observation: Observation) -> Float[Tensor, "B N d"]:
        return observation["ins"].double()

    def propagate(
        self,
        x: Float[Tensor, "*s 2d"],
        u: Float[Tensor, "*s d"],
        dt: Float[Tensor, "*s"],
        noise: Float[Tensor, "*s d"] | None = None,
    ) -> Float[Tensor, "*s 2d"]:
        if noise is not None:
            u = u + self.std * noise
        dt = dt.unsqueeze(-1)
        velocity = torch.where(dt > 0, u, x[..., self.dim :])
        return concat((x[..., : self.dim] + u * dt, velocity))

    def retreat(
        self, x: Float[Tensor, "*s 2d"], u: Float[Tensor, "*s d"], dt: Float[Tensor, "*s"]
    ) -> Float[Tensor, "*s 2d"]:
        return concat((x[..., : self.dim] - u * dt.unsqueeze(-1), x[..., self.dim :]))

    def linearize(
        self, x: Float[Tensor, "*s 2d"], u: Float[Tensor, "*s d"], dt: Float[Tensor, "*s"]
    ) -> tuple[Float[Tensor, "*s d d"], Float[Tensor, "*s d d"]]:
        eye = torch.eye(self.dim, dtype=x.dtype, device=x.device)
        q = (self.std * dt[..., None, None]) ** 2 * eye
        return eye.expand_as(q), q


class DisplacementProcess(PositionError):
    """x = [p, v], u = the measured displacement: p' = p + u, v' = u / dt; the error is δp.

    Q = (s₀² + s₁² D) I, D the distance that a displacement of u most likely came from.
    """

    def __init__(self, dim: int, dt: float, sensor: Displacement) -> None:
        super().__init__(dim, dt)
        self.sensor = sensor

    def inputs(self, observation: Observation) -> Float[Tensor, "B N d"]:
        return observation["displacement"].double()

    def _variance(self, u: Float[Tensor, "*s d"], dt: Float[Tensor, "*s"]) -> Float[Tensor, "*s 1"]:
        variance = self.sensor.variance(self.sensor.distance(u))
        return (variance * (dt / self.dt) ** 2).unsqueeze(-1)

    def propagate(
        self,
        x: Float[Tensor, "*s 2d"],
        u: Float[Tensor, "*s d"],
        dt: Float[Tensor, "*s"],
        noise: Float[Tensor, "*s d"] | None = None,
    ) -> Float[Tensor, "*s 2d"]:
        share = dt.unsqueeze(-1) / self.dt
        moved = u * share
        if noise is not None:
            moved = moved + self._variance(u, dt).sqrt() * noise
        velocity = torch.where(share > 0, moved / dt.unsqueeze(-1), x[..., self.dim :])
        return concat((x[..., : self.dim] + moved, velocity))

    def retreat(
        self, x: Float[Tensor, "*s 2d"], u: Float[Tensor, "*s d"], dt: Float[Tensor, "*s"]
    ) -> Float[Tensor, "*s 2d"]:
        share = dt.unsqueeze(-1) / self.dt
        return concat((x[..., : self.dim] - u * share, x[..., self.dim :]))

    def linearize(
        self, x: Float[Tensor, "*s 2d"], u: Float[Tensor, "*s d"], dt: Float[Tensor, "*s"]
    ) -> tuple[Float[Tensor, "*s d d"], Float[Tensor, "*s d d"]]:
        eye = torch.eye(self.dim, dtype=x.dtype, device=x.device)
        q = self._variance(u, dt).unsqueeze(-1) * eye
        return eye.expand_as(q), q
