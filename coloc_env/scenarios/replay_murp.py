"""``replay-murp-v0``: three agents that measure poses relative to each other by 36 UWB ranges."""

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from coloc_env.datasets import DataError, Recording
from coloc_env.datasets.antenna_arrays import relative_poses
from coloc_env.datasets.grid import Grid, common_grid
from coloc_env.datasets.replay import arena_of, lever_arms, recorded_motion, recorded_ranges
from coloc_env.geometry import Se3
from coloc_env.network import Network
from coloc_env.options import Degrees, Metres, Seconds, Share
from coloc_env.scenario import ConstantVelocity, Prior, Reward, Scenario
from coloc_env.scenarios.parts.replays import RecordingOptions
from coloc_env.sensors import Odometry, Ranging, RecordedPoses, Reference, RelativePose
from coloc_env.series import Series

_DT = 1.0  # s: the recording has one row a second
_HEIGHT_STD, _TILT_STD = 0.1, 0.05  # m, rad: of what is believed of the agents' heights and tilts
_FEWEST = 12  # ranges that a pose is solved from


@dataclass(frozen=True, eq=False)
class Solved:
    """Relative poses of M ordered pairs at T steps, solved from ranges, which are there, and what
    their deviations were on the first part: m and rad an axis."""

    pairs: tuple[tuple[int, int], ...]
    pose: Float64[Tensor, "T M 7"]
    covariance: Float64[Tensor, "T M 6 6"]
    there: Bool[Tensor, "T M"]
    std: float
    turn_std: float


@lru_cache(maxsize=4)
def solved(recording: Recording, steps: int) -> Solved:
    """The relative poses of all ordered pairs of agents at every second.

    On the first ``steps`` seconds are calibrated, with the truth: each agent's mean height, the
    bias (median) and robust deviation of the ranges between each two agents, and the deviations of
    the solved poses (root mean square). The bias is taken off all ranges.
    """
    grid = common_grid(recording, _DT, ())
    motion = recorded_motion(recording, grid)
    poses = torch.cat((motion.position.values, motion.attitude.values), -1)
    ranges, there = _ranges(recording, grid)
    pairs = tuple(permutations(range(len(recording.robots)), 2))
    first, second = torch.tensor(pairs).unbind(-1)
    truth = Se3.between(poses[:, first], poses[:, second])
    arms = torch.from_numpy(recording.tags)
    clean = torch.linalg.vector_norm(
        Se3.act(truth.unsqueeze(-2), arms[second]).unsqueeze(-3) - arms[first].unsqueeze(-2), dim=-1
    )
    measured, known = ranges[:, first, second], there[:, first, second]
    bias, std = torch.empty(len(pairs)).double(), torch.empty(len(pairs)).double()
    for pair, (i, j) in enumerate(pairs):
        both = [pair, pairs.index((j, i))]
        error = (measured - clean)[:steps, both][known[:steps, both]]
        bias[pair] = error.median()
        std[pair] = 1.4826 * (error - bias[pair]).abs().median()
    height = poses[:steps, :, 2].mean(0)
    above = (height[second] - height[first]).expand(len(poses), -1)
    pose, covariance = relative_poses(
        (measured - bias[:, None, None]).flatten(0, 1),
        known.flatten(0, 1),
        (arms[0], arms[0]),
        std.repeat(len(poses)),
        above.flatten(),
        math.sqrt(2) * _HEIGHT_STD,
        math.sqrt(2) * _TILT_STD,
    )
    pose = pose.unflatten(0, (len(poses), -1))
    off = Se3.minus(pose, truth)[:steps].square()
    return Solved(
        pairs,
        pose,
        covariance.unflatten(0, (len(poses), -1)),
        known.sum((-1, -2)) >= _FEWEST,
        float(off[..., :3].mean().sqrt()),
        float(off[..., 3:].mean().sqrt()),
    )


def replay_murp(
    *,
    calibration: Seconds = 60.0,
    outliers: Share = 0.0,
    odometry_noise: tuple[Metres, Degrees] = (0.02, 0.6),
    relative_pose_noise: tuple[Metres, Degrees] | None = None,
    reward: Reward = "error",
    replay: RecordingOptions = RecordingOptions(),
) -> Scenario:
    """Three agents with six UWB antennas each for some minutes, a step each second (MURP): at every
    step each ordered pair learns the relative pose that its 36 ranges say, by both ends.

    Agents are level to a few degrees and keep their heights, and are believed to: their antennas,
    all in one plane, cannot tell a pose from its mirror image. Heights, the ranges' biases and the
    poses' noise (``relative_pose_noise`` in m and degrees, if it is not given) are what the first
    ``calibration`` s say, which are not replayed (``span`` counts from their end).
    Simulated: odometry along the true path, with noise of ``odometry_noise`` (m and degrees a
    step, about that of a visual-inertial odometry), and ``outliers``, the share of poses that are
    replaced by others, drawn uniformly from the area and all rotations. Poses are relative to agent
    0's, as in ``stein3d-v0``; the team believes all but the outliers.
    """
    recording = replay.load("murp")
    whole = common_grid(recording, _DT, ())
    if not 10.0 <= calibration <= (whole.count - 2) * _DT:
        raise ValueError(
            f"calibration={calibration} is not allowed: from 10 s to {(whole.count - 2) * _DT:g}"
        )
    steps = round(calibration / _DT)
    found = solved(recording, steps)
    grid = replay.cut(Grid(int(whole.times[steps]), _DT, whole.count - steps))
    at = np.searchsorted(whole.times, grid.times)
    std, turn_std = found.std, found.turn_std
    if relative_pose_noise is not None:
        std, turn_std = relative_pose_noise[0], math.radians(relative_pose_noise[1])
    odometry, reference = Odometry.of_steps(odometry_noise, _DT), Reference()
    matches = RelativePose(len(found.pairs), std, turn_std)
    drawn = RelativePose(len(found.pairs), std, turn_std, outliers)
    measured = RecordedPoses(drawn, found.pairs, Series(found.pose[at]), Series(found.there[at]))
    return Scenario(
        name="replay-murp-v0",
        arena=arena_of(recording, grid, margin=0.5),
        horizon=grid.count - 1,
        motion=recorded_motion(recording, grid),
        sensors=(odometry, measured, reference),
        network=Network(),
        prior=Prior(kind="uniform", attitude_std=3.0),
        process=ConstantVelocity(accel_std=0.3),
        believed_sensors=(odometry, matches, reference),
        reward=reward,
        anchor_uavs=1,
    )


def _ranges(recording: Recording, grid: Grid) -> tuple[Tensor, Tensor]:
    """Ranges [T, N, N, I, J] between antenna i of one agent and j of another, and which are
    there."""
    tags, robots = recording.tags.shape[1], len(recording.robots)
    if not (recording.tags == recording.tags[0]).all():
        raise DataError(f"{recording.name}: its agents carry different antennas")
    recorded = recorded_ranges(recording, grid, Ranging(tags=lever_arms(recording))).series
    shape = (robots, tags, tags)
    ranges, there = (
        recorded[leaf].values.unflatten(-1, shape) for leaf in ("ranges", "range_mask")
    )
    return ranges.double(), there > 0
