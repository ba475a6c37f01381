"""Error-state models: how the errors of a state grow from one step to the next, at the truth.

Errors are on the manifold, attitude on the right: R exp(δθ). Each model gives, for truth [B, N, …]
one step apart, the transition F and the covariance Q of what the step adds, both [B, N, E, E].
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Float64
from torch import Tensor

from coloc_env.bounds.mixture import EXACT
from coloc_env.geometry import cross_matrix, rotation_between, rotation_matrix, unrotate
from coloc_env.motion import Kinematics
from coloc_env.observation import Observation
from coloc_env.scenario import (
    ConstantVelocity,
    DisplacementDriven,
    Inertial,
    InsDriven,
    Prior,
    Scenario,
    Wheeled,
)
from coloc_env.sensors import GRAVITY, Displacement, Imu, Ins, Odometry, Sensor
from coloc_env.sensors.base import RecordedSensor

Jacobians = tuple[Float64[Tensor, "B N E E"], Float64[Tensor, "B N E E"]]
S = TypeVar("S", bound=Sensor)


@dataclass(frozen=True)
class ErrorModel(ABC):
    """``dim`` d of the world and time step ``dt`` in s."""

    dim: int
    dt: float

    @abstractmethod
    def prior_std(self, prior: Prior, position: list[float]) -> list[float]:
        """Standard deviations [E] at step 0, given those of the position (m, per axis)."""

    @abstractmethod
    def transition(self, before: Kinematics, now: Kinematics, seen: Observation) -> Jacobians:
        """F and Q of the step from ``before`` to ``now``, which ends with what is ``seen``."""

    @abstractmethod
    def pose(self) -> Float64[Tensor, "D E"]:
        """What takes a state error to the pose error (δp, δθ) that sensors see; an attitude that is
        no state counts as known."""

    def velocity(self) -> Float64[Tensor, "d E"]:
        """What takes a state error to that of the velocity (m/s)."""
        motion = type(self).__name__.removesuffix("Errors")
        raise NotImplementedError(f"bounds: velocity is no state of {motion} motion")


@dataclass(frozen=True)
class InertialErrors(ErrorModel):
    """(δp, δv, δθ), and the IMU's biases (δb_a, δb_g) where it truly has some: constants that are
    drawn once."""

    imu: Imu

    @property
    def biased(self) -> bool:
        return self.imu.accel_bias > 0 or self.imu.gyro_bias > 0

    def prior_std(self, prior: Prior, position: list[float]) -> list[float]:
        motion = [*position, *3 * [prior.velocity_spread], *3 * [prior.attitude_std]]
        biases = [*3 * [self.imu.accel_bias], *3 * [self.imu.gyro_bias]]
        return motion + biases * self.biased

    def transition(self, before: Kinematics, now: Kinematics, seen: Observation) -> Jacobians:
        gravity = now.velocity.new_tensor((0.0, 0.0, GRAVITY))
        force = unrotate(before.attitude, (now.velocity - before.velocity) / self.dt + gravity)
        turn = rotation_between(before.attitude, now.attitude)
        f, g = strapdown_jacobians(rotation_matrix(before.attitude), force, turn, self.dt)
        std = g.new_tensor((self.imu.accel_std, self.imu.gyro_std))
        if "imu_unknown" in seen:  # samples are missing
            std = torch.hypot(std, seen["imu_unknown"].double())
        noise = g * std.repeat_interleave(3, -1).unsqueeze(-2)
        q = noise @ noise.mT
        if not self.biased:
            return f, q
        whole = torch.eye(15, dtype=f.dtype, device=f.device).repeat(*f.shape[:2], 1, 1)
        whole[..., :9, :9], whole[..., :9, 9:] = f, -g
        return whole, torch.nn.functional.pad(q, (0, 6, 0, 6))

    def pose(self) -> Float64[Tensor, "D E"]:
        return torch.eye(15 if self.biased else 9, dtype=torch.float64)[[0, 1, 2, 6, 7, 8]]

    def velocity(self) -> Float64[Tensor, "d E"]:
        return torch.eye(15 if self.biased else 9, dtype=torch.float64)[3:6]


@dataclass(frozen=True)
class WheeledErrors(ErrorModel):
    """(δp, δθ) in the plane, from odometry: p + R m dt, θ + ω dt."""

    odometry: Odometry

    def prior_std(self, prior: Prior, position: list[float]) -> list[float]:
        return [*position, prior.attitude_std]

    def transition(self, before: Kinematics, now: Kinematics, seen: Observation) -> Jacobians:
        rotation = rotation_matrix(before.attitude)
        moved = now.position - before.position
        f = torch.eye(3, dtype=moved.dtype, device=moved.device).repeat(*moved.shape[:2], 1, 1)
        f[..., 0, 2], f[..., 1, 2] = -moved[..., 1], moved[..., 0]
        turned = rotation_between(before.attitude, now.attitude)
        sample = torch.cat((unrotate(before.attitude, moved), turned), -1) / self.dt
        noise = torch.zeros_like(f)
        noise[..., :2, :2], noise[..., 2, 2] = rotation, 1.0
        std = self.odometry.std(sample)
        if "odometry_unknown" in seen:
            std = torch.hypot(std, seen["odometry_unknown"].double())
        noise = noise * (std * self.dt).unsqueeze(-2)
        return f, noise @ noise.mT

    def pose(self) -> Float64[Tensor, "D E"]:
        return torch.eye(3, dtype=torch.float64)


@dataclass(frozen=True)
class InsErrors(ErrorModel):
    """δp, and the INS's bias δb where it truly has one, from an INS: p + (u − b − noise) dt, and
    b₊ = e^(−dt/τ) b + noise that keeps its variance.

    A step's sample carries the bias of the step's end.
    """

    ins: Ins

    def prior_std(self, prior: Prior, position: list[float]) -> list[float]:
        return [*position, *self.dim * [self.ins.bias]] if self.ins.bias else position

    def transition(self, before: Kinematics, now: Kinematics, seen: Observation) -> Jacobians:
        kept = math.exp(-self.dt / self.ins.bias_time)
        white, fresh = (self.ins.std * self.dt) ** 2, (1 - kept**2) * self.ins.bias**2
        if self.ins.bias:
            f = torch.tensor(((1.0, -kept * self.dt), (0.0, kept)), dtype=torch.float64)
            push = torch.tensor((-self.dt, 1.0), dtype=torch.float64)
            q = fresh * push.outer(push) + white * torch.tensor(
                ((1.0, 0.0), (0.0, 0.0)), dtype=torch.float64
            )
        else:
            f, q = (
                torch.ones(1, 1).double(),
                torch.full((1, 1), white, dtype=torch.float32).double(),
            )
        axes = torch.eye(self.dim, dtype=torch.float64)
        f, q = (torch.kron(x, axes).to(now.position) for x in (f, q))
        shape = (*now.position.shape[:2], *f.shape)
        return f.expand(shape), q.expand(shape)

    def pose(self) -> Float64[Tensor, "D E"]:
        pose = torch.eye(6 if self.dim == 3 else 3, self.dim, dtype=torch.float64)
        return torch.nn.functional.pad(pose, (0, self.dim)) if self.ins.bias else pose


@dataclass(frozen=True)
class DisplacementErrors(ErrorModel):
    """δp, from displacements: p + z, z of variance s₀² + s₁² D over a true distance D."""

    sensor: Displacement

    def prior_std(self, prior: Prior, position: list[float]) -> list[float]:
        return position

    def transition(self, before: Kinematics, now: Kinematics, seen: Observation) -> Jacobians:
        variance = self.sensor.variance((now.position - before.position).norm(dim=-1))
        eye = torch.eye(self.dim).to(now.position)
        q = variance[..., None, None] * eye
        return eye.expand_as(q), q

    def pose(self) -> Float64[Tensor, "D E"]:
        return torch.eye(6 if self.dim == 3 else 3, self.dim, dtype=torch.float64)


@dataclass(frozen=True)
class ConstantVelocityErrors(ErrorModel):
    """(δp, δv): ṗ = v, v̇ = −v/τ + white noise, integrated exactly over a step (with damping the
    integrated Ornstein–Uhlenbeck process), or noise that is held over the step. Attitude, where a
    sensor needs it, counts as known."""

    process: ConstantVelocity

    def prior_std(self, prior: Prior, position: list[float]) -> list[float]:
        return [*position, *self.dim * [prior.velocity_spread]]

    def transition(self, before: Kinematics, now: Kinematics, seen: Observation) -> Jacobians:
        rate = 1 / self.process.damping if self.process.damping else 0.0
        system = torch.tensor(((0.0, 1.0), (0.0, -rate)), dtype=torch.float64)
        drive = torch.tensor(((0.0, 0.0), (0.0, self.process.accel_std**2)), dtype=torch.float64)
        axes = torch.eye(self.dim, dtype=torch.float64)
        shape = (*now.position.shape[:2], 2 * self.dim, 2 * self.dim)
        f, q = discretise(system, drive, self.dt)
        if self.process.held:
            gain = (
                self.process.accel_std
                * torch.tensor((0.5 * self.dt**2, self.dt), dtype=torch.float32).double()
            )
            q = gain.outer(gain)
        f, q = (torch.kron(x, axes).to(now.position) for x in (f, q))
        return f.expand(shape), q.expand(shape)

    def pose(self) -> Float64[Tensor, "D E"]:
        pose = torch.zeros(6 if self.dim == 3 else 3, 2 * self.dim, dtype=torch.float64)
        pose[: self.dim, : self.dim] = torch.eye(self.dim)
        return pose

    def velocity(self) -> Float64[Tensor, "d E"]:
        return torch.eye(2 * self.dim, dtype=torch.float64)[self.dim :]


def error_model(scenario: Scenario) -> ErrorModel:
    """The model of a scenario's process, with the noise of its *true* IMU, INS or odometry."""
    dim, dt = scenario.arena.dim, scenario.arena.dt
    match scenario.process:
        case Inertial():
            return InertialErrors(dim, dt, _true(scenario, Imu))
        case Wheeled():
            return WheeledErrors(dim, dt, _true(scenario, Odometry))
        case InsDriven():
            return InsErrors(dim, dt, _true(scenario, Ins))
        case DisplacementDriven():
            return DisplacementErrors(dim, dt, _true(scenario, Displacement))
        case ConstantVelocity() as process:
            return ConstantVelocityErrors(dim, dt, process)


def prior_covariance(model: ErrorModel, scenario: Scenario) -> Float64[Tensor, "E E"]:
    """Covariance of one UAV's errors before anything is measured.

    A uniform prior of the position is taken as a Gaussian with its variance, room²/12 per axis: an
    approximation (a uniform density has no Fisher information to add), soon forgotten.
    """
    arena, prior = scenario.arena, scenario.prior
    if prior.kind == "uniform":
        sides = zip(arena.low, arena.high, strict=True)
        position = [(high - low) / 12**0.5 for low, high in sides]
    else:
        position = arena.dim * [prior.position_std]
    std = torch.tensor(model.prior_std(prior, position), dtype=torch.float64)
    return std.clamp_min(EXACT).square().diag()


def true_sensors(scenario: Scenario) -> list[Sensor]:
    """What measures truly; of a recording, the sensor that describes its leaves."""
    return [s.sensor if isinstance(s, RecordedSensor) else s for s in scenario.sensors]


def strapdown_jacobians(
    rotation: Float64[Tensor, "*s 3 3"],
    force: Float64[Tensor, "*s 3"],
    turn: Float64[Tensor, "*s 3"],
    dt: float,
) -> tuple[Float64[Tensor, "*s 9 9"], Float64[Tensor, "*s 9 6"]]:
    """F by (δp, δv, δθ) and G by errors of (specific force m/s², angular rate rad/s) of

    p + v dt + ½ (R f + g) dt², v + (R f + g) dt, R exp(ω dt),

    with R at the step's start, where the sample's body frame is, and ``turn`` = ω dt.
    """
    f = torch.eye(9, dtype=rotation.dtype, device=rotation.device).repeat(*force.shape[:-1], 1, 1)
    g = f.new_zeros(*force.shape[:-1], 9, 6)
    lever = -rotation @ cross_matrix(force)
    f[..., 0, 3] = f[..., 1, 4] = f[..., 2, 5] = dt
    f[..., 0:3, 6:9], f[..., 3:6, 6:9] = 0.5 * dt**2 * lever, dt * lever
    right = right_jacobian(turn)
    f[..., 6:9, 6:9] = torch.eye(3, dtype=f.dtype, device=f.device) - right @ cross_matrix(turn)
    g[..., 0:3, 0:3], g[..., 3:6, 0:3] = 0.5 * dt**2 * rotation, dt * rotation
    g[..., 6:9, 3:6] = dt * right
    return f, g


def right_jacobian(turn: Float64[Tensor, "*s 3"]) -> Float64[Tensor, "*s 3 3"]:
    """``exp(φ + δ) ≈ exp(φ) exp(J δ)`` on SO(3); ``exp(−φ) = I − J [φ]×``."""
    angle = turn.norm(dim=-1)[..., None, None]
    small = angle < 0.01
    safe = torch.where(small, 1.0, angle)
    second = torch.where(small, 1 / 6 - angle**2 / 120, (safe - safe.sin()) / safe**3)
    first = 0.5 * torch.sinc(0.5 * angle / torch.pi) ** 2
    cross = cross_matrix(turn)
    identity = torch.eye(3, dtype=turn.dtype, device=turn.device)
    return identity - first * cross + second * cross @ cross


def discretise(
    system: Float64[Tensor, "n n"], drive: Float64[Tensor, "n n"], dt: float
) -> tuple[Float64[Tensor, "n n"], Float64[Tensor, "n n"]]:
    """``ẋ = A x + w``, w white with density ``drive``, over ``dt``: F = exp(A dt) and Q (Van Loan,
    IEEE Trans. Automatic Control 1978)."""
    n = len(system)
    upper = torch.cat((-system, drive), -1)
    lower = torch.cat((torch.zeros_like(drive), system.mT), -1)
    both = torch.linalg.matrix_exp(dt * torch.cat((upper, lower)))
    f = both[n:, n:].mT.contiguous()
    return f, f @ both[:n, n:]


def _true(scenario: Scenario, kind: type[S]) -> S:
    for sensor in true_sensors(scenario):
        if isinstance(sensor, kind):
            return sensor
    process = type(scenario.process).__name__
    raise ValueError(f"{scenario.name}: the process {process} needs the sensor {kind.__name__}")
