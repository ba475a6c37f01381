"""Inertial measurement unit: specific force and angular rate in the body frame."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import rotation_between, unrotate
from coloc_env.options import Acceleration, AngularRate, Group
from coloc_env.sensors.base import Layout, Leaf, RecordedSensor, Sensor, Window, require

GRAVITY = 9.80665  # m/s², along -z of the world


@dataclass(frozen=True)
class Imu(Sensor):
    """Leaf ``imu`` [6]: specific force (m/s²) and angular rate (rad/s), body FLU.

    Each sample is the *mean over the step that ends now*, compensated for rotation within it
    (coning and sculling), in the body frame at the step's start: with no noise, the strapdown
    update ``q ⊗ exp(ω dt)``, ``v + (R f + g) dt`` leads from one true state to the next exactly.
    At step 0 no step has passed: the sample is that of a UAV at rest.

    ``accel_std``, ``gyro_std``: white noise of one sample. ``accel_bias``, ``gyro_bias``: standard
    deviations of a bias drawn once per UAV and world.
    """

    may_be_blind = False

    accel_std: float = 0.05
    gyro_std: float = 0.01
    accel_bias: float = 0.0
    gyro_bias: float = 0.0

    def __post_init__(self) -> None:
        for name in ("accel_std", "gyro_std", "accel_bias", "gyro_bias"):
            require(getattr(self, name) >= 0, self, name, "a standard deviation ≥ 0")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        require(layout.arena.dim == 3, "Imu", "dim", "an IMU needs a 3-D scenario")
        return {"imu": Leaf(6, unit="m/s², rad/s", frame="body")}

    def place(self, keys: Int64[Tensor, "R"], layout: Layout) -> dict[str, Tensor]:
        if not (self.accel_bias or self.gyro_bias):
            return {}
        bias = noise.normal(keys, "imu.bias", 6 * layout.arena.n_uavs)
        scale = bias.new_tensor([self.accel_bias] * 3 + [self.gyro_bias] * 3)
        return {"bias": bias.unflatten(-1, (-1, 6)) * scale}

    def turn_rate(self, leaves: Mapping[str, Float32[Tensor, "B N F"]]) -> Float32[Tensor, "B N t"]:
        return leaves["imu"][..., 3:]

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        now, before, dt = window.motion, window.before, window.layout.arena.dt
        gravity = now.velocity.new_tensor((0.0, 0.0, GRAVITY))
        force = unrotate(before.attitude, (now.velocity - before.velocity) / dt + gravity)
        rate = rotation_between(before.attitude, now.attitude) / dt
        clean = torch.cat((force, rate), -1).to(torch.float32)
        white = noise.normal(window.keys, "imu", clean.shape[-2] * 6).unflatten(-1, (-1, 6))
        std = clean.new_tensor([self.accel_std] * 3 + [self.gyro_std] * 3)
        imu = white.mul_(std).add_(clean)
        if "bias" in placed:
            imu.add_(placed["bias"].unsqueeze(1))
        return {"imu": imu.mul_(window.alive.unsqueeze(-1))}


@dataclass(frozen=True, eq=False)
class RecordedImu(RecordedSensor):
    """A recorded ``Imu`` that may have more leaves beside the mean over each step:

    ``imu_unknown`` [2]: what the mean is off for want of samples, standard deviations an axis of
    accelerometer (m/s²) and gyro (rad/s), to be added to ``accel_std`` and ``gyro_std``, which are
    those of the mean as ever. ``imu_samples`` [S · 6] and ``imu_held`` [S]: each sample in the step
    that ends now, as it was measured, and for how long it holds (s; 0 where there is none).
    """

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        more = {name: one.values.shape[-1] for name, one in self.series.items() if name != "imu"}
        lowest = {"imu_samples": -float("inf")}
        own = {
            name: Leaf(width, lowest.get(name, 0.0), unit="m/s², rad/s", frame="body")
            if name != "imu_held"
            else Leaf(width, 0.0, unit="s")
            for name, width in more.items()
        }
        return super().leaves(layout) | own


@dataclass(frozen=True)
class ImuOptions(Group):
    """``accel_std`` and ``gyro_std``: white noise of one sample (the mean over a step)."""

    title: ClassVar[str] = "IMU"

    accel_std: Acceleration = 0.05
    gyro_std: AngularRate = 0.01

    @property
    def believed(self) -> Imu:
        """The sensor as the team believes it to be: its biases, if any, are states."""
        return Imu(self.accel_std, self.gyro_std)


@dataclass(frozen=True)
class SimulatedImuOptions(ImuOptions):
    """With ``imu_bias``, each UAV's sensors have constant biases of standard deviations
    ``accel_bias`` and ``gyro_bias``; ``believed_imu_bias``: whether the team estimates biases
    (none: if there are any). ``imu=false`` leaves the IMU out, and a constant-velocity model."""

    imu: bool = True
    imu_bias: bool = False
    accel_bias: Acceleration = 0.1
    gyro_bias: AngularRate = 0.01
    believed_imu_bias: bool | None = None

    @property
    def true(self) -> Imu:
        """The sensor as it is."""
        if not self.imu_bias:
            return self.believed
        return Imu(self.accel_std, self.gyro_std, self.accel_bias, self.gyro_bias)

    @property
    def estimated(self) -> bool:
        """Whether the team estimates biases."""
        return self.imu_bias if self.believed_imu_bias is None else self.believed_imu_bias
