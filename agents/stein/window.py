"""The matches that a holder remembers: ring buffers that move along with the team."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.tensorclasses import build
from coloc_env.geometry import Poses
from coloc_env.observation import Observation


@dataclass(frozen=True)
class Matches:
    """What holders are told in a step: the pose of UAV ``second`` in the frame of UAV ``first``,
    and which of the C entries are there."""

    first: Int64[Tensor, "B H C"]
    second: Int64[Tensor, "B H C"]
    pose: Float64[Tensor, "B H C P"]
    told: Bool[Tensor, "B H C"]


class Window(TensorClass):
    """The last W matches of each holder, moved along to the present; batch (B, H).

    ``grown``: variance that odometry has added since they were measured (position m², turn rad²).
    ``cursor``: where the next one goes.
    """

    first: Int64[Tensor, "B H W"]
    second: Int64[Tensor, "B H W"]
    pose: Float64[Tensor, "B H W P"]
    grown: Float64[Tensor, "B H W 2"]
    held: Bool[Tensor, "B H W"]
    cursor: Int64[Tensor, "B H"]


def empty(poses: type[Poses], shape: torch.Size, size: int, like: Tensor) -> Window:
    """Nothing remembered, in ``size`` slots."""
    index = torch.zeros(*shape, size, dtype=torch.int64, device=like.device)
    return build(
        Window,
        shape,
        first=index,
        second=index,
        pose=poses.identity(like).expand(*shape, size, -1).clone(),
        grown=like.new_zeros(*shape, size, 2),
        held=torch.zeros_like(index, dtype=torch.bool),
        cursor=index[..., 0],
    )


def matches(
    poses: type[Poses], observation: Observation, heard: Bool[Tensor, "B H N"], everyone: bool
) -> Matches:
    """The matches that holders are ends of or, with ``everyone``, those of all they hear as well
    (each told by its first end). A match with a UAV that is not ``heard`` is of no use: where it
    went since is not known."""
    told = observation["relative_pose_mask"] > 0
    slots = told.shape[-1]
    ends = observation["relative_pose_ends"].unflatten(-1, (slots, 2))
    pose = observation["relative_poses"].unflatten(-1, (slots, poses.size)).double()
    told = told & pose.isfinite().all(-1) & ends.isfinite().all(-1)
    pose = torch.where(told.unsqueeze(-1), pose, poses.identity(pose))
    first, second = torch.where(told.unsqueeze(-1), ends, 0.0).to(torch.int64).unbind(-1)
    if everyone:
        n = told.shape[1]
        teller = torch.arange(n, device=told.device).unsqueeze(-1)
        holder = teller.unsqueeze(-1)
        news = (first == teller).unsqueeze(1) & (second.unsqueeze(1) != holder)
        told = told.unsqueeze(1) & heard.unsqueeze(-1) & ((holder == teller) | news)
        told = told.flatten(2)
        pose, first, second = (
            part.unsqueeze(1).expand(-1, n, *part.shape[1:]).flatten(2, 3)
            for part in (pose, first, second)
        )
    told = told & heard.gather(2, first) & heard.gather(2, second)
    return Matches(first, second, pose, told)


def moved(
    poses: type[Poses],
    window: Window,
    step: Float64[Tensor, "B H N P"],
    std: tuple[float, float],
) -> Window:
    """T ← D_i⁻¹ T D_j with what each agent moved. Odometry of ``std`` (m, rad) a step adds its
    variance at both ends, and turns what the first end sees at a distance |t|, which moves all
    axes but one."""
    here, there = agents_of(step, window.first), agents_of(step, window.second)
    pose = poses.between(here, poses.compose(window.pose, there))
    lever = poses.split(pose)[0].square().sum(-1) * (poses.dim - 1) / poses.dim
    turn = torch.full_like(lever, 2 * std[1] ** 2)
    added = torch.stack((2 * std[0] ** 2 + lever * std[1] ** 2, turn), -1)
    return window.replace(pose=pose, grown=window.grown + added)


def stored(window: Window, new: Matches) -> Window:
    """The window with what is new in place of what is oldest."""
    size = window.held.shape[-1]
    count = new.told.to(torch.int64).cumsum(-1)
    slot = torch.where(new.told, (window.cursor.unsqueeze(-1) + count - 1) % size, size)

    def put(old: Tensor, values: Tensor) -> Tensor:
        rest = (1,) * (old.dim() - 3)
        index = slot.reshape(*slot.shape, *rest).expand(*slot.shape, *old.shape[3:])
        spare = torch.cat((old, old[:, :, :1]), 2)
        return spare.scatter(2, index, values)[:, :, :size]

    return build(
        Window,
        window.cursor.shape,
        first=put(window.first, new.first),
        second=put(window.second, new.second),
        pose=put(window.pose, new.pose),
        grown=put(window.grown, torch.zeros_like(new.pose[..., :2])),
        held=put(window.held, new.told),
        cursor=(window.cursor + count[..., -1]) % size,
    )


def agents_of(
    values: Float64[Tensor, "B H N *x"], index: Int64[Tensor, "B H W"]
) -> Float64[Tensor, "B H W *x"]:
    """What belongs to the agents named."""
    rest = values.shape[3:]
    wide = index.reshape(*index.shape, *(1,) * len(rest)).expand(*index.shape, *rest)
    return values.gather(2, wide)
