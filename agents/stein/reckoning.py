"""What each holder knows of everybody's motion: odometry, summed up by each UAV and told to those
that hear it."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.tensorclasses import build
from coloc_env.geometry import Poses
from coloc_env.observation import Observation


class Tracks(TensorClass):
    """``own``: each UAV's pose by its odometry alone, relative to its first one; ``known``: what of
    it each holder was told last (for agent N), and how many steps ago; batch (B, H)."""

    own: Float64[Tensor, "B H P"]
    known: Float64[Tensor, "B H N P"]
    age: Int64[Tensor, "B H N"]


@dataclass(frozen=True)
class Moves:
    """How far agents went since a holder last heard of them (no move for those it does not hear
    now), and over how many steps."""

    step: Float64[Tensor, "B H N P"]
    steps: Int64[Tensor, "B H N"]


def begun(poses: type[Poses], shape: torch.Size, like: Tensor) -> Tracks:
    """Tracks before the first step."""
    b, n = shape
    start = poses.identity(like)
    return build(
        Tracks,
        shape,
        own=start.expand(b, n, -1).clone(),
        known=start.expand(b, n, n, -1).clone(),
        age=torch.zeros(b, n, n, dtype=torch.int64, device=like.device),
    )


def told(
    poses: type[Poses],
    tracks: Tracks,
    observation: Observation,
    dt: Float64[Tensor, "B H"],
    heard: Bool[Tensor, "B H N"],
) -> tuple[Tracks, Moves]:
    """The tracks after a step of ``dt`` s, and what holders learn from those that they hear
    (themselves included)."""
    own = poses.compose(tracks.own, increments(poses, observation, dt))
    now = own.unsqueeze(1).expand_as(tracks.known)
    row = heard.unsqueeze(-1)
    age = tracks.age + (dt > 0).unsqueeze(-1)
    step = torch.where(row, poses.between(tracks.known, now), poses.identity(own))
    after = build(
        Tracks,
        tracks.batch_size,
        own=own,
        known=torch.where(row, now, tracks.known),
        age=torch.where(heard, 0, age),
    )
    return after, Moves(step, torch.where(heard, age, 0))


def increments(
    poses: type[Poses], observation: Observation, dt: Float64[Tensor, "B N"]
) -> Float64[Tensor, "B N P"]:
    """What odometry says each UAV did in a step of ``dt`` s; nothing where it says no number."""
    speed = observation["odometry"].double()
    usable = speed.isfinite().all(-1, keepdim=True)
    moved = torch.where(usable, speed, 0.0) * dt.unsqueeze(-1)
    shift, turn = moved[..., : poses.dim], moved[..., poses.dim :]
    turned = poses.split(poses.exp(torch.cat((torch.zeros_like(shift), turn), -1)))[1]
    return torch.cat((shift, turned), -1)


def carried(
    poses: type[Poses], x: Float64[Tensor, "*s N P"], step: Float64[Tensor, "*s N P"]
) -> Float64[Tensor, "*s N P"]:
    """D_0⁻¹ x D_j: poses relative to UAV 0, after everybody has moved."""
    return poses.between(step[..., :1, :], poses.compose(x, step))
