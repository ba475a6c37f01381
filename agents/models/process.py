"""What a team believes of its motion: one interface, four models, batched over anything.

A state is a flat tensor ``[position, velocity, attitude?, biases?]``; its error lives in the
tangent space (attitude perturbed on the right, in the body frame), of size ``error_size``. Position
is always ``x[..., :d]``, velocity ``x[..., d:2d]`` and the position's error ``δ[..., :d]``.
"""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models import rotations
from agents.models.rotations import rotate, rotate_by, rotation_between
from coloc_env import scenario as believed_processes
from coloc_env.geometry import concat, cross_matrix
from coloc_env.observation import Observation
from coloc_env.scenario import Believed
from coloc_env.sensors import GRAVITY, Imu, Ins, Odometry


class Process(ABC):
    """A motion model. ``attitude_error`` is the attitude's slice of the error, if it is a state."""

    state_size: int
    error_size: int
    noise_size: int
    attitude_size: int = 0
    attitude_error: slice | None = None

    def __init__(self, dim: int, dt: float) -> None:
        self.dim, self.dt = dim, dt

    @abstractmethod
    def inputs(self, observation: Observation) -> Float[Tensor, "B N U"]:
        """What drives the model over the step that ends now (float64)."""

    @abstractmethod
    def propagate(
        self,
        x: Float[Tensor, "*s S"],
        u: Float[Tensor, "*s U"],
        dt: Float[Tensor, "*s"],
        noise: Float[Tensor, "*s W"] | None = None,
    ) -> Float[Tensor, "*s S"]:
        """The state after ``dt`` seconds; a sample of it with standard normal ``noise``."""

    @abstractmethod
    def retreat(
        self, x: Float[Tensor, "*s S"], u: Float[Tensor, "*s U"], dt: Float[Tensor, "*s"]
    ) -> Float[Tensor, "*s S"]:
        """The state ``dt`` seconds earlier: what ``propagate`` takes to ``x`` without noise."""

    @abstractmethod
    def linearize(
        self, x: Float[Tensor, "*s S"], u: Float[Tensor, "*s U"], dt: Float[Tensor, "*s"]
    ) -> tuple[Float[Tensor, "*s E E"], Float[Tensor, "*s E E"]]:
        """Transition matrix F of the error over one step from ``x``, and process noise Q."""

    def initial(
        self, prior: Float[Tensor, "*s W"]
    ) -> tuple[Float[Tensor, "*s S"], Float[Tensor, "*s E E"]]:
        """Mean and error covariance that the prior leaf states."""
        d, a = self.dim, 4 if self.dim == 3 else 1
        mean, std = prior[..., : 2 * d + a], prior[..., 2 * d + a :]
        parts = [std[..., :d], std[..., d : d + 1].expand_as(std[..., :d])]
        if self.attitude_size:
            parts.append(std[..., d + 1 :].expand(*std.shape[:-1], d if d == 3 else 1))
        return self._initial(mean, torch.cat(parts, -1))

    def _initial(
        self, mean: Float[Tensor, "*s W"], std: Float[Tensor, "*s E"]
    ) -> tuple[Float[Tensor, "*s S"], Float[Tensor, "*s E E"]]:
        return mean[..., : self.state_size], torch.diag_embed(std**2)

    def rotation(self, x: Float[Tensor, "*s S"]) -> Float[Tensor, "*s d d"] | None:
        """Body-to-world matrix, None where attitude is no state."""
        return rotations.matrix(self.attitude(x)) if self.attitude_size else None

    def attitude(self, x: Float[Tensor, "*s S"]) -> Float[Tensor, "*s a"]:
        """The attitude's part of the state."""
        return x[..., 2 * self.dim : 2 * self.dim + self.attitude_size]

    def boxplus(
        self, x: Float[Tensor, "*s S"], delta: Float[Tensor, "*s E"]
    ) -> Float[Tensor, "*s S"]:
        """``x ⊞ δ``."""
        if not self.attitude_size:
            return x + self._linear(delta)
        d, a = self.dim, self.attitude_size
        e = self.attitude_error
        assert e is not None
        linear = x[..., : 2 * d] + self._linear(delta)
        turned = rotate_by(x[..., 2 * d : 2 * d + a], delta[..., e])
        rest = x[..., 2 * d + a :] + delta[..., e.stop :]
        return concat((linear, turned, rest))

    def boxminus(self, x: Float[Tensor, "*s S"], y: Float[Tensor, "*s S"]) -> Float[Tensor, "*s E"]:
        """``x ⊟ y``: the δ with ``y ⊞ δ = x``."""
        difference = x - y
        if not self.attitude_size:
            return difference
        d, a = self.dim, self.attitude_size
        e = self.attitude_error
        assert e is not None
        turn = rotation_between(y[..., 2 * d : 2 * d + a], x[..., 2 * d : 2 * d + a])
        return concat((difference[..., : e.start], turn, difference[..., 2 * d + a :]))

    def _linear(self, delta: Float[Tensor, "*s E"]) -> Float[Tensor, "*s 2d"]:
        return delta[..., : 2 * self.dim]


class InertialProcess(Process):
    """Strapdown integration: x = [p, v, q] or [p, v, q, b_a, b_g], u = [f, ω], error size 9 or 15.

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
            biases = [self.settings.accel_bias] * 3 + [self.settings.gyro_bias] * 3
            std = torch.cat((std, std.new_tensor(biases).expand(*std.shape[:-1], 6)), -1)
            mean = torch.cat((mean, mean.new_zeros(*mean.shape[:-1], 6)), -1)
        return mean, torch.diag_embed(std**2)

    def inputs(self, observation: Observation) -> Float[Tensor, "B N 6"]:
        return observation["imu"].double()

    def propagate(
        self,
        x: Float[Tensor, "*s S"],
        u: Float[Tensor, "*s 6"],
        dt: Float[Tensor, "*s"],
        noise: Float[Tensor, "*s W"] | None = None,
    ) -> Float[Tensor, "*s S"]:
        p, v, q, biases = x[..., :3], x[..., 3:6], x[..., 6:10], x[..., 10:]
        dt = dt.unsqueeze(-1)
        if self.biased:
            u = u - biases
        if noise is not None:
            std = u.new_tensor([self.imu.accel_std] * 3 + [self.imu.gyro_std] * 3)
            u = u + std * noise[..., :6]
            if self.walks:
                walk = u.new_tensor([self.settings.accel_walk] * 3 + [self.settings.gyro_walk] * 3)
                biases = biases + walk * dt.sqrt() * noise[..., 6:]
        a = rotate(q, u[..., :3]) - u.new_tensor((0.0, 0.0, GRAVITY))
        q = rotate_by(q, u[..., 3:] * dt)
        return concat((p + (v + 0.5 * a * dt) * dt, v + a * dt, q, biases))

    def retreat(
        self, x: Float[Tensor, "*s S"], u: Float[Tensor, "*s 6"], dt: Float[Tensor, "*s"]
    ) -> Float[Tensor, "*s S"]:
        p, v, q, biases = x[..., :3], x[..., 3:6], x[..., 6:10], x[..., 10:]
        dt = dt.unsqueeze(-1)
        if self.biased:
            u = u - biases
        q = rotate_by(q, -u[..., 3:] * dt)
        a = rotate(q, u[..., :3]) - u.new_tensor((0.0, 0.0, GRAVITY))
        v = v - a * dt
        return concat((p - (v + 0.5 * a * dt) * dt, v, q, biases))

    def linearize(
        self, x: Float[Tensor, "*s S"], u: Float[Tensor, "*s 6"], dt: Float[Tensor, "*s"]
    ) -> tuple[Float[Tensor, "*s E E"], Float[Tensor, "*s E E"]]:
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
        return f, self.added.to(x) * moving

    def _constants(self) -> tuple[Float[Tensor, "E E"], Float[Tensor, "E E"]]:
        """The parts of F and Q over one step that no state changes."""
        h, e = self.dt, self.error_size
        f, q = torch.eye(e, dtype=torch.float64), torch.zeros(e, e, dtype=torch.float64)
        eye = torch.eye(3, dtype=torch.float64)
        f[:3, 3:6] = h * eye
        accel, gyro = (self.imu.accel_std * h) ** 2, (self.imu.gyro_std * h) ** 2
        q[:3, :3] = 0.25 * accel * h**2 * eye
        q[:3, 3:6] = q[3:6, :3] = 0.5 * accel * h * eye
        q[3:6, 3:6] = accel * eye
        q[6:9, 6:9] = gyro * eye
        if self.biased:
            f[6:9, 12:15] = -h * eye
            q[9:12, 9:12] = self.settings.accel_walk**2 * h * eye
            q[12:15, 12:15] = self.settings.gyro_walk**2 * h * eye
        return f, q


class WheeledProcess(Process):
    """Planar dead reckoning: x = [p, v, θ], u = odometry [forward, left, turn] per second.

    The velocity is what odometry says, not an estimated quantity: the error is [δp, δθ].
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

    def inputs(self, observation: Observation) -> Float[Tensor, "B N 3"]:
        return observation["odometry"].double()

    def propagate(
        self,
        x: Float[Tensor, "*s 5"],
        u: Float[Tensor, "*s 3"],
        dt: Float[Tensor, "*s"],
        noise: Float[Tensor, "*s 3"] | None = None,
    ) -> Float[Tensor, "*s 5"]:
        if noise is not None:
            u = u + self.odometry.std(u) * noise
        dt = dt.unsqueeze(-1)
        velocity = rotate(x[..., 4:], u[..., :2])
        position = x[..., :2] + velocity * dt
        velocity = torch.where(dt > 0, velocity, x[..., 2:4])
        return concat((position, velocity, rotate_by(x[..., 4:], u[..., 2:] * dt)))

    def retreat(
        self, x: Float[Tensor, "*s 5"], u: Float[Tensor, "*s 3"], dt: Float[Tensor, "*s"]
    ) -> Float[Tensor, "*s 5"]:
        dt = dt.unsqueeze(-1)
        heading = rotate_by(x[..., 4:], -u[..., 2:] * dt)
        return concat((x[..., :2] - rotate(heading, u[..., :2]) * dt, x[..., 2:4], heading))

    def linearize(
        self, x: Float[Tensor, "*s 5"], u: Float[Tensor, "*s 3"], dt: Float[Tensor, "*s"]
    ) -> tuple[Float[Tensor, "*s 3 3"], Float[Tensor, "*s 3 3"]]:
        h = dt[..., None]
        rotation = rotations.matrix(x[..., 4:])
        forward = (rotation @ u[..., :2, None])[..., 0] * h
        f = torch.eye(3, dtype=x.dtype, device=x.device).expand(*x.shape[:-1], 3, 3).clone()
        f[..., 0, 2], f[..., 1, 2] = -forward[..., 1], forward[..., 0]
        variance = (self.odometry.std(u) * h) ** 2
        q = torch.zeros_like(f)
        q[..., :2, :2] = (rotation * variance[..., None, :2]) @ rotation.mT
        q[..., 2, 2] = variance[..., 2]
        return f, q

    def boxminus(self, x: Float[Tensor, "*s 5"], y: Float[Tensor, "*s 5"]) -> Float[Tensor, "*s 3"]:
        turn = rotation_between(y[..., 4:], x[..., 4:])
        return concat((x[..., :2] - y[..., :2], turn))

    def _linear(self, delta: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 4"]:
        return torch.cat((delta[..., :2], torch.zeros_like(delta[..., :2])), -1)


class InsProcess(Process):
    """x = [p, v], u = the velocity that the INS says: p' = p + u dt, v' = u.

    The velocity is what the INS says, not an estimated quantity: the error is δp.
    """

    def __init__(
        self, dim: int, dt: float, ins: Ins, settings: believed_processes.InsDriven
    ) -> None:
        super().__init__(dim, dt)
        self.std = (ins.std**2 + settings.bias_share * ins.bias**2) ** 0.5
        self.state_size, self.error_size, self.noise_size = 2 * dim, dim, dim

    def _initial(
        self, mean: Float[Tensor, "*s W"], std: Float[Tensor, "*s 2d"]
    ) -> tuple[Float[Tensor, "*s 2d"], Float[Tensor, "*s d d"]]:
        return mean[..., : self.state_size], torch.diag_embed(std[..., : self.dim] ** 2)

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

    def boxminus(
        self, x: Float[Tensor, "*s 2d"], y: Float[Tensor, "*s 2d"]
    ) -> Float[Tensor, "*s d"]:
        return x[..., : self.dim] - y[..., : self.dim]

    def _linear(self, delta: Float[Tensor, "*s d"]) -> Float[Tensor, "*s 2d"]:
        return torch.cat((delta, torch.zeros_like(delta)), -1)


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


def make_process(believed: Believed) -> Process:
    """The motion model that a team believes in; ValueError if a sensor it needs is missing."""
    settings, arena = believed.process, believed.arena
    if isinstance(settings, believed_processes.ConstantVelocity):
        return ConstantVelocityProcess(arena.dim, arena.dt, settings)
    if isinstance(settings, believed_processes.Inertial):
        imu = believed.sensor(Imu)
        if imu is None:
            raise ValueError("the believed motion is inertial, but the team has no IMU")
        return InertialProcess(arena.dt, imu, settings)
    if isinstance(settings, believed_processes.InsDriven):
        ins = believed.sensor(Ins)
        if ins is None:
            raise ValueError("the believed motion is driven by an INS, but the team has none")
        return InsProcess(arena.dim, arena.dt, ins, settings)
    odometry = believed.sensor(Odometry)
    if odometry is None:
        raise ValueError("the believed motion is wheeled, but the team has no odometry")
    return WheeledProcess(arena.dt, odometry)
