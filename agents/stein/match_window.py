"""The window of a holder's last matches: a ring buffer, propagated with the team's motion."""

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
    """A step's matches T_{i→j}: the ``pose`` of UAV ``second`` in the frame of UAV ``first``, and
    which of the C entries are valid (``mask``)."""

    first: Int64[Tensor, "B H C"]
    second: Int64[Tensor, "B H C"]
    pose: Float64[Tensor, "B H C P"]
    mask: Bool[Tensor, "B H C"]


class MatchWindow(TensorClass):
    """The last W matches of each holder, propagated to the present; batch (B, H).

    ``added_variance``: that of odometry since they were measured (position m², rotation rad²);
    ``mask``: which slots are filled; ``cursor``: slot of the next match.
    """

    first: Int64[Tensor, "B H W"]
    second: Int64[Tensor, "B H W"]
    pose: Float64[Tensor, "B H W P"]
    added_variance: Float64[Tensor, "B H W 2"]
    mask: Bool[Tensor, "B H W"]
    cursor: Int64[Tensor, "B H"]


def empty(poses: type[Poses], shape: torch.Size, size: int, like: Tensor) -> MatchWindow:
    """A window of ``size`` empty slots."""
    index = torch.zeros(*shape, size, dtype=torch.int64, device=like.device)
    return build(
        MatchWindow,
        shape,
        first=index,
        second=index,
        pose=poses.identity(like).expand(*shape, size, -1).clone(),
        added_variance=like.new_zeros(*shape, size, 2),
        mask=torch.zeros_like(index, dtype=torch.bool),
        cursor=index[..., 0],
    )


def observed_matches(
    poses: type[Poses], observation: Observation, linked: Bool[Tensor, "B H N"], broadcast: bool
) -> Matches:
    """The matches that holders are ends of or, with ``broadcast``, those of all UAVs they are
    ``linked`` to as well (each sent by its first end). A match with a UAV without a link is
    dropped, as its motion is not received."""
    mask = observation["relative_pose_mask"] > 0
    slots = mask.shape[-1]
    ends = observation["relative_pose_ends"].unflatten(-1, (slots, 2))
    pose = observation["relative_poses"].unflatten(-1, (slots, poses.size)).double()
    mask = mask & pose.isfinite().all(-1) & ends.isfinite().all(-1)
    pose = torch.where(mask.unsqueeze(-1), pose, poses.identity(pose))
    first, second = torch.where(mask.unsqueeze(-1), ends, 0.0).to(torch.int64).unbind(-1)
    if broadcast:
        n = mask.shape[1]
        sender = torch.arange(n, device=mask.device).unsqueeze(-1)
        holder = sender.unsqueeze(-1)
        new = (first == sender).unsqueeze(1) & (second.unsqueeze(1) != holder)
        mask = mask.unsqueeze(1) & linked.unsqueeze(-1) & ((holder == sender) | new)
        mask = mask.flatten(2)
        pose, first, second = (
            part.unsqueeze(1).expand(-1, n, *part.shape[1:]).flatten(2, 3)
            for part in (pose, first, second)
        )
    mask = mask & linked.gather(2, first) & linked.gather(2, second)
    return Matches(first, second, pose, mask)


def propagate(
    poses: type[Poses],
    window: MatchWindow,
    motion: Float64[Tensor, "B H N P"],
    std: tuple[float, float],
) -> MatchWindow:
    """T ← D_i⁻¹ T D_j with the agents' motion D. Odometry of ``std`` (m, rad) a step adds its
    variance at both ends; the rotation of the first end acts on |t| as a lever, across all axes
    but one."""
    here, there = agents_of(motion, window.first), agents_of(motion, window.second)
    pose = poses.between(here, poses.compose(window.pose, there))
    lever = poses.split(pose)[0].square().sum(-1) * (poses.dim - 1) / poses.dim
    rotation = torch.full_like(lever, 2 * std[1] ** 2)
    added = torch.stack((2 * std[0] ** 2 + lever * std[1] ** 2, rotation), -1)
    return window.replace(pose=pose, added_variance=window.added_variance + added)


def insert(window: MatchWindow, new: Matches) -> MatchWindow:
    """The window with the new matches in place of the oldest ones."""
    added = torch.zeros_like(new.pose[..., :2])
    return build(MatchWindow, window.cursor.shape, **inserted(window, new, added_variance=added))


def inserted(window: MatchWindow, new: Matches, **more: Tensor) -> dict[str, Tensor]:
    """The window's entries with the new matches in place of the oldest ones; ``more``: what is kept
    of each new match beside it."""
    size = window.mask.shape[-1]
    count = new.mask.to(torch.int64).cumsum(-1)
    slot = torch.where(new.mask, (window.cursor.unsqueeze(-1) + count - 1) % size, size)

    def put(old: Tensor, values: Tensor) -> Tensor:
        rest = (1,) * (old.dim() - 3)
        index = slot.reshape(*slot.shape, *rest).expand(*slot.shape, *old.shape[3:])
        spare = torch.cat((old, old[:, :, :1]), 2)
        return spare.scatter(2, index, values)[:, :, :size]

    found = {name: put(window.get(name), values) for name, values in (vars(new) | more).items()}
    return found | {"cursor": (window.cursor + count[..., -1]) % size}


def agents_of(
    values: Float64[Tensor, "B H N *x"], index: Int64[Tensor, "B H W"]
) -> Float64[Tensor, "B H W *x"]:
    """The values of the agents with this index."""
    rest = values.shape[3:]
    wide = index.reshape(*index.shape, *(1,) * len(rest)).expand(*index.shape, *rest)
    return values.gather(2, wide)
