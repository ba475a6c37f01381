"""What a team believes of its motion: one interface, six models, batched over anything.

A state is a flat tensor ``[position, velocity, attitude?, biases?]``; its error lives in the
tangent space (attitude perturbed on the right, in the body frame), of size ``error_size``. Position
is always ``x[..., :d]``, velocity ``x[..., d:2d]`` and the position's error ``δ[..., :d]``.
"""

import math

from agents.errors import NotServed
from agents.models.process.base import Process
from agents.models.process.constant_velocity import ConstantVelocityProcess
from agents.models.process.drifting import DriftingProcess
from agents.models.process.inertial import InertialProcess
from agents.models.process.reckoned import DisplacementProcess, InsProcess, WheeledProcess
from coloc_env import scenario as believed_processes
from coloc_env.scenario import Believed
from coloc_env.sensors import Displacement, Height, Imu, Ins, Odometry, Sensor

__all__ = [
    "ConstantVelocityProcess",
    "DisplacementProcess",
    "DriftingProcess",
    "InertialProcess",
    "InsProcess",
    "Process",
    "WheeledProcess",
    "drives",
    "make_process",
]


_VAGUE = 0.01  # of the arena's diagonal
_INPUTS: dict[type, type[Sensor]] = {  # what drives a motion model
    believed_processes.Inertial: Imu,
    believed_processes.InsDriven: Ins,
    believed_processes.Wheeled: Odometry,
    believed_processes.DisplacementDriven: Displacement,
}


def drives(believed: Believed, sensor: Sensor) -> bool:
    """Whether a sensor is what the believed motion model is driven by."""
    return isinstance(sensor, _INPUTS.get(type(believed.process), ()))


def make_process(believed: Believed) -> Process:
    """The motion model that a team believes in; ValueError if a sensor it needs is missing."""
    process, height = _process(believed), believed.sensor(Height)
    if height is not None and height.estimated and height.bias_std:
        process = DriftingProcess(process, height)
    process.any_yaw = believed.prior.yaw == "uniform"
    process.vague = max(process.vague, _VAGUE * math.dist(believed.arena.low, believed.arena.high))
    return process


def _process(believed: Believed) -> Process:
    settings, arena = believed.process, believed.arena
    if isinstance(settings, believed_processes.ConstantVelocity):
        return ConstantVelocityProcess(arena.dim, arena.dt, settings)
    if isinstance(settings, believed_processes.Inertial):
        imu = believed.sensor(Imu)
        if imu is None:
            raise NotServed("the believed motion is inertial, but the team has no IMU")
        return InertialProcess(arena.dt, imu, settings)
    if isinstance(settings, believed_processes.InsDriven):
        ins = believed.sensor(Ins)
        if ins is None:
            raise NotServed("the believed motion is driven by an INS, but the team has none")
        return InsProcess(arena.dim, arena.dt, ins, settings)
    if isinstance(settings, believed_processes.DisplacementDriven):
        displacement = believed.sensor(Displacement)
        if displacement is None:
            raise NotServed("the believed motion is driven by displacements, but none is measured")
        return DisplacementProcess(arena.dim, arena.dt, displacement)
    if isinstance(settings, believed_processes.Wheeled):
        odometry = believed.sensor(Odometry)
        if odometry is None:
            raise NotServed("the believed motion is wheeled, but the team has no odometry")
        return WheeledProcess(arena.dt, odometry)
    raise NotServed(f"{type(settings).__name__} motion has no model")
