"""Strapdown integration of an IMU."""

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models import rotations
from agents.models.process.base import LEAST_STD, Process
from agents.models.rotations import concat, rotate, rotate_by
from coloc_env import scenario as believed_processes
from coloc_env.geometry import cross_matrix
from coloc_env.observation import Observation
from coloc_env.sensors import GRAVITY, Imu


class InertialProcess(Process):
    """Strapdown integration: x = [p, v, q] or [p, v, q, b_a, b_g], u = [f, ω], error size 9 or 15.

    Where samples of a recorded IMU are missing u = [f, ω, s_f, s_ω], with the standard deviations
    of what they leave unknown, which add to the noise: σ² + s².

    v' = v + (R (f − b_a) + g) dt,  p' = p + v dt + ½ (…) dt²,  q' = q ⊗ exp((ω − b_g) dt)
    (PF-NN paper, section 2.1, with the noise entering through the measured f and ω).
    """

    attitude_size = 4
    attitude_error = slice(6, 9)

    def __init__(self, dt: float, imu: Imu, settings: believed_processes.Inertial) -> None:
        super().__init__(3, dt)
        self.imu, self.settings = imu, settings
        self.biased = bool(settings.accel_bias or settings.gyro_bias)
        self.walks = self.biased and bool(settings.accel_walk or settings.gyro_walk)
        self.noise_size = 12 if self.walks else 6
        self.state_size, self.error_size = (16, 15) if self.biased else (10, 9)
        self.fixed, self.added = self._constants()

    def _initial(
        self, mean: Float[Tensor, "*s 10"], std: Float[Tensor, "*s 9"]
    ) -> tuple[Float[Tensor, "*s S"], Float[Tensor, "*s E E"]]:
        if self.biased:
            stds = (self.settings.accel_bias, self.settings.gyro_bias)
            biases = [max(std, LEAST_STD) for std in stds for _ in range(3)]
            std = torch.cat((std, std.new_tensor(biases).expand(*std.shape[:-1], 6)), -1)
            mean = torch.cat((mean, mean.new_zeros(*mean.shape[:-1], 6)), -1)
        return mean, torch.diag_embed(std**2)

    def inputs(self, observation: Observation) -> Float[Tensor, "B N U"]:
        imu = observation["imu"].double()
        if "imu_unknown" not in observation:
            return imu
        unknown = observation["imu_unknown"].double().expand(*imu.shape[:-1], -1)
        return torch.cat((imu, unknown), -1)

    def propagate(
        self,
        x: Float[Tensor, "*s S"],
        u: Float[Tensor, "*s U"],
        dt: Float[Tensor, "*s"],
        noise: Float[Tensor, "*s W"] | None = None,
    ) -> Float[Tensor, "*s S"]:
        p, v, q, biases = x[..., :3], x[..., 3:6], x[..., 6:10], x[..., 10:]
        dt = dt.unsqueeze(-1)
        u, unknown = u[..., :6], u[..., 6:]
        if self.biased:
            u = u - biases
        if noise is not None:
            std = u.new_tensor([self.imu.accel_std] * 3 + [self.imu.gyro_std] * 3)
            if unknown.shape[-1]:
                std = torch.hypot(std, unknown.repeat_interleave(3, -1))
            u = u + std * noise[..., :6]
            if self.walks:
                walk = u.new_tensor([self.settings.accel_walk] * 3 + [self.settings.gyro_walk] * 3)
                biases = biases + walk * dt.sqrt() * noise[..., 6:]
        a = rotate(q, u[..., :3]) - u.new_tensor((0.0, 0.0, GRAVITY))
        q = rotate_by(q, u[..., 3:] * dt)
        return concat((p + (v + 0.5 * a * dt) * dt, v + a * dt, q, biases))

    def retreat(
        self, x: Float[Tensor, "*s S"], u: Float[Tensor, "*s U"], dt: Float[Tensor, "*s"]
    ) -> Float[Tensor, "*s S"]:
        p, v, q, biases = x[..., :3], x[..., 3:6], x[..., 6:10], x[..., 10:]
        dt, u = dt.unsqueeze(-1), u[..., :6]
        if self.biased:
            u = u - biases
        q = rotate_by(q, -u[..., 3:] * dt)
        a = rotate(q, u[..., :3]) - u.new_tensor((0.0, 0.0, GRAVITY))
        v = v - a * dt
        return concat((p - (v + 0.5 * a * dt) * dt, v, q, biases))

    def linearize(
        self, x: Float[Tensor, "*s S"], u: Float[Tensor, "*s U"], dt: Float[Tensor, "*s"]
    ) -> tuple[Float[Tensor, "*s E E"], Float[Tensor, "*s E E"]]:
        u, unknown = u[..., :6], u[..., 6:]
        if self.biased:
            u = u - x[..., 10:]
        rotation = rotations.matrix(x[..., 6:10])
        h, moving = dt[..., None, None], (dt > 0)[..., None, None]
        still = torch.eye(self.error_size, dtype=x.dtype, device=x.device)
        f = torch.where(moving, self.fixed.to(x), still)
        turn = -rotation @ cross_matrix(u[..., :3]) * h
        f[..., :3, 6:9] = 0.5 * turn * h
        f[..., 3:6, 6:9] = turn
        f[..., 6:9, 6:9] = rotations.matrix(rotations.exp(-u[..., 3:] * dt.unsqueeze(-1)))
        if self.biased:
            f[..., :3, 9:12] = -0.5 * rotation * h**2
            f[..., 3:6, 9:12] = -rotation * h
        q = self.added.to(x)
        if unknown.shape[-1]:
            q = q + self.strapdown_noise(*unknown.unbind(-1))
        return f, q * moving

    def strapdown_noise(
        self, accel_std: Float[Tensor, "*s"], gyro_std: Float[Tensor, "*s"]
    ) -> Float[Tensor, "*s E E"]:
        """Q over one step from white noise of f (m/s²) and ω (rad/s)."""
        h, eye = self.dt, torch.eye(3, dtype=accel_std.dtype, device=accel_std.device)
        accel = (accel_std * h).square()[..., None, None] * eye
        q = accel.new_zeros(*accel.shape[:-2], self.error_size, self.error_size)
        q[..., :3, :3] = 0.25 * h**2 * accel
        q[..., :3, 3:6] = q[..., 3:6, :3] = 0.5 * h * accel
        q[..., 3:6, 3:6] = accel
        q[..., 6:9, 6:9] = (gyro_std * h).square()[..., None, None] * eye
        return q

    def _constants(self) -> tuple[Float[Tensor, "E E"], Float[Tensor, "E E"]]:
        """The parts of F and Q over one step that no state changes."""
        h, e = self.dt, self.error_size
        f = torch.eye(e, dtype=torch.float64)
        eye = torch.eye(3, dtype=torch.float64)
        f[:3, 3:6] = h * eye
        q = self.strapdown_noise(
            *torch.tensor([self.imu.accel_std, self.imu.gyro_std], dtype=torch.float64)
        )
        if self.biased:
            f[6:9, 12:15] = -h * eye
            q[9:12, 9:12] = self.settings.accel_walk**2 * h * eye
            q[12:15, 12:15] = self.settings.gyro_walk**2 * h * eye
        return f, q
