"""Information of all of a scenario's sensors in one step, at the truth and in expectation over
where the team may be."""

from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from coloc_env.bounds.information import (
    informs_of_motion,
    motion_information,
    own_information,
    shared_information,
)
from coloc_env.geometry import rotate_by
from coloc_env.motion import Kinematics
from coloc_env.observation import Observation
from coloc_env.sensors import Displacement, Imu, Ins, Odometry, Sensor

_DRIVERS = (Displacement, Imu, Ins, Odometry)
# About single UAVs' states, and about the team's (None: no sensor has it).
Information = tuple[Float64[Tensor, "B N E E"], Float64[Tensor, "B m m"] | None]


def expected_information(
    sensors: list[Sensor],
    truth: Kinematics,
    seen: Observation,
    drawn: Float64[Tensor, "B N E"],
    pose: Float64[Tensor, "D E"],
    velocity: Float64[Tensor, "d E"] | None = None,
) -> Information:
    """``E Σ Hᵀ R⁻¹ H`` about the states, of which ``pose`` makes poses and ``velocity`` (needed
    where a sensor informs of it) velocities.

    The expectation is the mean over the truth moved by +drawn and −drawn state errors.
    """
    there, what = moved(truth, drawn @ pose.mT), twice(seen)
    own, shared = pose_information(sensors, there, what)
    found = about_states(pose, _mean(own), None if shared is None else _mean(shared))
    about_motion = [sensor for sensor in sensors if informs_of_motion(sensor)]
    if not about_motion:
        return found
    assert velocity is not None
    faster = drawn @ velocity.mT
    there = replace(there, velocity=there.velocity + torch.cat((faster, -faster)))
    both = torch.cat((pose, velocity))
    for sensor in about_motion:
        information = _mean(motion_information(sensor, there, what))
        found = (found[0] + both.mT @ information @ both, found[1])
    return found


def pose_information(
    sensors: list[Sensor], truth: Kinematics, seen: Observation
) -> tuple[Float64[Tensor, "B N D D"], Float64[Tensor, "B N D N D"] | None]:
    """``Σ Hᵀ R⁻¹ H`` at the truth: about single UAVs' poses, and about the team's (None: no sensor
    has it). IMU, INS, odometry and displacements drive the process, and count there; what is about
    velocities, too, says nothing of poses alone."""
    size = 6 if truth.position.shape[-1] == 3 else 3
    own = truth.position.new_zeros(*truth.position.shape[:2], size, size)
    shared = None
    for sensor in sensors:
        if sensor.between_uavs:
            joint = shared_information(sensor, truth, seen)
            shared = joint if shared is None else shared + joint
        elif not (isinstance(sensor, _DRIVERS) or informs_of_motion(sensor)):
            own += own_information(sensor, truth, seen)
    return own, shared


def about_states(
    pose: Float64[Tensor, "D E"],
    own: Float64[Tensor, "B N D D"],
    shared: Float64[Tensor, "B N D N D"] | None,
) -> Information:
    """From information about poses to that about the states behind them."""
    own = pose.mT @ own @ pose
    if shared is None:
        return own, None
    joint = torch.einsum("de,bidjf,fg->biejg", pose, shared, pose)
    return own, joint.flatten(3, 4).flatten(1, 2)


def moved(truth: Kinematics, errors: Float64[Tensor, "B N D"]) -> Kinematics:
    """2B worlds: the truth with its poses moved by +errors, then by −errors (m, rad)."""
    d = truth.position.shape[-1]
    both = torch.cat((errors, -errors))
    return Kinematics(
        truth.position.repeat(2, 1, 1) + both[..., :d],
        truth.velocity.repeat(2, 1, 1),
        rotate_by(truth.attitude.repeat(2, 1, 1), both[..., d:]),
    )


def twice(seen: Observation) -> Observation:
    return Observation({name: leaf.repeat(2, 1, 1) for name, leaf in seen.leaves.items()})


def _mean(information: Tensor) -> Tensor:
    """Over the two halves of the worlds."""
    return information.unflatten(0, (2, -1)).mean(0)
