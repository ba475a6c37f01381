"""Motion: integrated by each UAV, by odometry or (see ``galilean``) by its IMU, and sent to the
holders that it has links to."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.stein.galilean import Galilean
from agents.tensorclasses import build
from coloc_env.geometry import Poses
from coloc_env.observation import Observation

Group = type[Poses] | type[Galilean]


class Tracks(TensorClass):
    """``own``: each UAV's motion since the start by its odometry or IMU alone; ``received``: what
    each holder received of agents' own tracks last, ``age`` steps ago; batch (B, H)."""

    own: Float64[Tensor, "B H P"]
    received: Float64[Tensor, "B H N P"]
    age: Int64[Tensor, "B H N"]


@dataclass(frozen=True)
class Motion:
    """``moved``: agents' motion D_j since a holder last received it (the identity for those without
    a link now), over so many ``steps``."""

    moved: Float64[Tensor, "B H N P"]
    steps: Int64[Tensor, "B H N"]


def initial(group: Group, shape: torch.Size, like: Tensor) -> Tracks:
    """Tracks before the first step."""
    b, n = shape
    start = group.identity(like)
    return build(
        Tracks,
        shape,
        own=start.expand(b, n, -1).clone(),
        received=start.expand(b, n, n, -1).clone(),
        age=torch.zeros(b, n, n, dtype=torch.int64, device=like.device),
    )


def exchange(
    group: Group,
    tracks: Tracks,
    increments: Float64[Tensor, "B N P"],
    dt: Float64[Tensor, "B H"],
    linked: Bool[Tensor, "B H N"],
) -> tuple[Tracks, Motion]:
    """The tracks after a step of ``dt`` s in which UAVs moved by ``increments``, and the motion
    that holders receive from agents they have a link to (themselves included)."""
    own = group.compose(tracks.own, increments)
    sent = own.unsqueeze(1).expand_as(tracks.received)
    row = linked.unsqueeze(-1)
    age = tracks.age + (dt > 0).unsqueeze(-1)
    motion = torch.where(row, group.between(tracks.received, sent), group.identity(own))
    after = build(
        Tracks,
        tracks.batch_size,
        own=own,
        received=torch.where(row, sent, tracks.received),
        age=torch.where(linked, 0, age),
    )
    return after, Motion(motion, torch.where(linked, age, 0))


def increments(
    poses: type[Poses], observation: Observation, dt: Float64[Tensor, "B N"]
) -> Float64[Tensor, "B N P"]:
    """Each UAV's motion by odometry in a step of ``dt`` s; the identity where it is not finite."""
    speed = observation["odometry"].double()
    usable = speed.isfinite().all(-1, keepdim=True)
    moved = torch.where(usable, speed, 0.0) * dt.unsqueeze(-1)
    shift, turn = moved[..., : poses.dim], moved[..., poses.dim :]
    rotation = poses.split(poses.exp(torch.cat((torch.zeros_like(shift), turn), -1)))[1]
    return torch.cat((shift, rotation), -1)


def speed(
    poses: type[Poses], observation: Observation, moved: Bool[Tensor, "B N"]
) -> Float64[Tensor, "B N d"]:
    """The velocity by odometry (m/s, body frame); 0 before UAVs have ``moved``."""
    measured = observation["odometry"][..., : poses.dim].double()
    return torch.where(moved.unsqueeze(-1), measured, 0.0)


def propagate(
    poses: type[Poses], x: Float64[Tensor, "*s N P"], motion: Float64[Tensor, "*s N P"]
) -> Float64[Tensor, "*s N P"]:
    """x_j ← D_0⁻¹ x_j D_j: poses relative to UAV 0 after the ``motion`` D (equation 29)."""
    return poses.between(motion[..., :1, :], poses.compose(x, motion))
