"""Relative poses between UAVs, as matches of what their cameras see give them: some are wrong."""

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import poses_in, rotate_by
from coloc_env.motion import Arena
from coloc_env.options import Degrees, Group, Metres, PositiveCount, Share
from coloc_env.sensors.base import MASK, Layout, Leaf, Sensor, Window, require
from coloc_env.series import Series


@dataclass(frozen=True)
class RelativePose(Sensor):
    """Leaves ``relative_poses`` [M · P], ``relative_pose_mask`` [M] and ``relative_pose_ends``
    [M · 2]: at each step M = ``matches`` ordered pairs (i, j) of UAVs are drawn, each alike, and
    UAVs i and j both learn the pose of j in the body frame of i: position (m), then quaternion
    wxyz (P = 7) or heading in rad (P = 3). ``relative_pose_ends``: i and j.

    Position noise has ``std`` m per axis, rotation noise ``turn_std`` rad per body axis. With
    probability ``outliers`` a match is wrong: it shows j at a pose drawn uniformly from the arena
    and from all rotations. A pair whose link does not reach learns nothing.
    """

    between_uavs = True

    matches: int = 1
    std: float = 0.05
    turn_std: float = math.radians(2.0)
    outliers: float = 0.0

    def __post_init__(self) -> None:
        require(self.matches >= 1, self, "matches", "at least one match a step")
        for name in ("std", "turn_std"):
            require(getattr(self, name) >= 0, self, name, "a standard deviation ≥ 0")
        require(0 <= self.outliers <= 1, self, "outliers", "a probability in [0, 1]")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        arena = layout.arena
        return {
            "relative_poses": Leaf(
                self.matches * poses_in(arena.dim).size,
                unit="m, quaternion" if arena.dim == 3 else "m, rad",
                frame="body of the first",
            ),
            "relative_pose_mask": Leaf(self.matches, *MASK),
            "relative_pose_ends": Leaf(2 * self.matches, 0.0, float(max(1, arena.n_uavs - 1))),
        }

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        arena = window.layout.arena
        first, second = _pairs(window.keys, arena.n_uavs, self.matches)
        pose = torch.cat((window.motion.position, window.motion.attitude), -1)
        wrong, other = self.mistaken(window.keys, arena)
        shown = torch.where(wrong, other, _of(pose, second))
        clean = poses_in(arena.dim).between(_of(pose, first), shown).to(torch.float32)
        pose = self._noisy(clean, window.keys, arena.dim)
        return _leaves(first, second, pose, _held(window, first, second))

    def mistaken(
        self, keys: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Bool[Tensor, "R K M 1"], Float64[Tensor, "R K M P"]]:
        """Which matches are wrong, and the pose in the world that they show instead."""
        m, low = self.matches, torch.tensor(arena.low, dtype=torch.float64, device=keys.device)
        drawn = noise.uniform(keys, "relative_pose.outlier", m * (1 + arena.dim)).double()
        wrong, place = drawn.unflatten(-1, (m, -1)).split((1, arena.dim), -1)
        place = low + (low.new_tensor(arena.high) - low) * place
        return wrong < self.outliers, torch.cat((place, _uniform_attitudes(keys, m, arena.dim)), -1)

    def _noisy(
        self, clean: Float32[Tensor, "R K M P"], keys: Int64[Tensor, "R K"], dim: int
    ) -> Float32[Tensor, "R K M P"]:
        """T exp(noise): isotropic, so the same in either body frame."""
        turns = 3 if dim == 3 else 1
        white = noise.normal(keys, "relative_pose", self.matches * (dim + turns))
        shift, turn = white.unflatten(-1, (self.matches, -1)).split((dim, turns), -1)
        position = clean[..., :dim] + self.std * shift
        attitude = rotate_by(clean[..., dim:], self.turn_std * turn)
        if dim == 3:
            attitude = torch.where(attitude[..., :1] < 0, -attitude, attitude)
        return torch.cat((position, attitude), -1)


@dataclass(frozen=True, eq=False)
class RecordedPoses(Sensor):
    """The leaves of ``sensor`` from a recording: at step k the pose ``poses[k, m]`` [T, M, P] of
    the second UAV of ``pairs[m]`` in the body frame of the first, where it is ``there`` [T, M].

    What is recorded has its own noise. Wrong matches are drawn as ``sensor`` draws them, in place
    of what is recorded.
    """

    between_uavs = True
    may_be_blind = False

    sensor: RelativePose
    pairs: tuple[tuple[int, int], ...]
    poses: Series
    there: Series
    dropped: dict[str, int] = field(default_factory=dict)

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        return self.sensor.leaves(layout)

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        arena, steps = window.layout.arena, window.steps
        first, second = torch.tensor(self.pairs, device=steps.device).mT.unbind(0)
        first, second = (x.expand(*steps.shape, -1) for x in (first, second))
        wrong, other = self.sensor.mistaken(window.keys, arena)
        seen_from = _of(torch.cat((window.motion.position, window.motion.attitude), -1), first)
        shown = poses_in(arena.dim).between(seen_from, other)
        pose = torch.where(wrong, shown, self.poses.at(steps)).to(torch.float32)
        held = _held(window, first, second) & self.there.at(steps).unsqueeze(2)
        return _leaves(first, second, pose, held)


@dataclass(frozen=True)
class RelativePoseOptions(Group):
    """In each step ``matches_per_step`` random pairs of UAVs measure their relative pose, with
    standard deviations ``relative_pose_noise`` in m and degrees. A share ``outliers`` of these is
    wrong, uniform over the arena and all rotations; the team believes all of them.
    """

    title: ClassVar[str] = "relative poses"

    matches_per_step: PositiveCount = 1
    relative_pose_noise: tuple[Metres, Degrees] = (0.05, 2.0)
    outliers: Share = 0.2

    @property
    def true(self) -> RelativePose:
        """The sensor as it is."""
        return replace(self.believed, outliers=self.outliers)

    @property
    def believed(self) -> RelativePose:
        """The sensor that the team believes in."""
        std, turn_std = self.relative_pose_noise
        return RelativePose(self.matches_per_step, std, math.radians(turn_std))


def _leaves(
    first: Int64[Tensor, "R K M"],
    second: Int64[Tensor, "R K M"],
    pose: Float32[Tensor, "R K M P"],
    held: Bool[Tensor, "R K N M"],
) -> dict[str, Tensor]:
    """The leaves of each UAV: the matches that it holds."""
    ends = torch.stack((first, second), -1).unsqueeze(2) * held.unsqueeze(-1)
    return {
        "relative_poses": (pose.unsqueeze(2) * held.unsqueeze(-1)).flatten(-2),
        "relative_pose_mask": held.to(torch.float32),
        "relative_pose_ends": ends.flatten(-2).to(torch.float32),
    }


def _pairs(
    keys: Int64[Tensor, "R K"], n: int, matches: int
) -> tuple[Int64[Tensor, "R K M"], Int64[Tensor, "R K M"]]:
    """Ordered pairs of different UAVs, each as likely as any other; (0, 0) where there is but one
    UAV."""
    drawn = noise.uniform(keys, "relative_pose.pair", 2 * matches).unflatten(-1, (matches, 2))
    first = (drawn[..., 0] * n).to(torch.int64).clamp(max=n - 1)
    further = (drawn[..., 1] * (n - 1)).to(torch.int64).clamp(max=max(0, n - 2))
    return first, (first + 1 + further) % n


def _of(
    values: Float64[Tensor, "R K N x"], index: Int64[Tensor, "R K M"]
) -> Float64[Tensor, "R K M x"]:
    """The values of the UAVs named."""
    return values.gather(2, index.unsqueeze(-1).expand(-1, -1, -1, values.shape[-1]))


def _uniform_attitudes(
    keys: Int64[Tensor, "R K"], count: int, dim: int
) -> Float64[Tensor, "R K M a"]:
    """Attitudes uniform over all rotations: headings, or directions of Gaussian vectors in R⁴."""
    if dim == 2:
        share = noise.uniform(keys, "relative_pose.turned", count).double().unsqueeze(-1)
        return torch.pi * (2 * share - 1)
    drawn = noise.normal(keys, "relative_pose.turned", 4 * count).double().unflatten(-1, (-1, 4))
    w, x, y, z = drawn.unbind(-1)
    return drawn / (w * w + x * x + y * y + z * z).sqrt().unsqueeze(-1)


def _held(
    window: Window, first: Int64[Tensor, "R K M"], second: Int64[Tensor, "R K M"]
) -> Bool[Tensor, "R K N M"]:
    """Which UAVs hold which matches: both ends, if their link reaches."""
    slots = window.reach.shape[-1]
    rows = first.unsqueeze(-1).expand(-1, -1, -1, slots)
    reach = window.reach.gather(2, rows)
    neighbours = window.neighbours.expand_as(window.reach).gather(2, rows)
    linked = (reach & (neighbours == second.unsqueeze(-1))).any(-1).unsqueeze(2)
    uav = torch.arange(window.layout.arena.n_uavs, device=first.device).unsqueeze(-1)
    return linked & ((first.unsqueeze(2) == uav) | (second.unsqueeze(2) == uav))
