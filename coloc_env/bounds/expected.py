"""What all of a scenario's sensors tell in one step, in expectation over where the team may be."""

import torch
from jaxtyping import Float64
from torch import Tensor

from coloc_env.bounds.information import SHARED, own_information, shared_information
from coloc_env.geometry import rotate_by
from coloc_env.motion import Kinematics
from coloc_env.observation import Observation
from coloc_env.sensors import Imu, Ins, Odometry, Sensor


def expected_information(
    sensors: list[Sensor],
    truth: Kinematics,
    seen: Observation,
    drawn: Float64[Tensor, "B N E"],
    pose: Float64[Tensor, "D E"],
) -> tuple[Float64[Tensor, "B N E E"], Float64[Tensor, "B m m"] | None]:
    """``E Σ Hᵀ R⁻¹ H`` about single UAVs' states, and about the team's (None: no sensor has it).

    The expectation is the mean over the truth moved by +drawn and −drawn state errors. IMU, INS
    and odometry drive the process, and count there.
    """
    size, n = pose.shape[1], drawn.shape[1]
    own, shared = torch.zeros(*drawn.shape, size, dtype=torch.float64), None
    truth, seen = moved(truth, drawn @ pose.mT), _twice(seen)
    for sensor in sensors:
        if isinstance(sensor, SHARED):
            joint = _mean(shared_information(sensor, truth, seen))
            joint = torch.einsum("de,bidjf,fg->biejg", pose, joint, pose)
            joint = joint.reshape(-1, n * size, n * size)
            shared = joint if shared is None else shared + joint
        elif not isinstance(sensor, Imu | Ins | Odometry):
            own += pose.mT @ _mean(own_information(sensor, truth, seen)) @ pose
    return own, shared


def moved(truth: Kinematics, errors: Float64[Tensor, "B N D"]) -> Kinematics:
    """2B worlds: the truth with its poses moved by +errors, then by −errors (m, rad)."""
    d = truth.position.shape[-1]
    both = torch.cat((errors, -errors))
    return Kinematics(
        truth.position.repeat(2, 1, 1) + both[..., :d],
        truth.velocity.repeat(2, 1, 1),
        rotate_by(truth.attitude.repeat(2, 1, 1), both[..., d:]),
    )


def _twice(seen: Observation) -> Observation:
    return Observation({name: leaf.repeat(2, 1, 1) for name, leaf in seen.leaves.items()})


def _mean(information: Tensor) -> Tensor:
    """Over the two halves of the worlds."""
    return information.unflatten(0, (2, -1)).mean(0)
