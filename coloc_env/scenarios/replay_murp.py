"""``replay-murp-v0``: three agents that measure poses relative to each other by 36 UWB ranges."""

import math

import numpy as np

from coloc_env.datasets.grid import Grid, common_grid
from coloc_env.datasets.murp_poses import DT, solved
from coloc_env.datasets.replay import arena_of, recorded_motion
from coloc_env.network import Network
from coloc_env.options import Degrees, Metres, Seconds, Share
from coloc_env.scenario import ConstantVelocity, Prior, Reward, Scenario
from coloc_env.scenarios.parts.replays import RecordingOptions
from coloc_env.sensors import Odometry, RecordedPoses, Reference, RelativePose
from coloc_env.series import Series


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
    step both of each ordered pair learn the relative pose that was solved from their 36 ranges.

    Agents are level to a few degrees and keep their heights, and are believed to: their antennas,
    all in one plane, cannot distinguish a pose from its mirror image. Heights, the ranges' biases
    and the poses' noise (``relative_pose_noise`` in m and degrees, if it is not given) are those of
    the first ``calibration`` s, which are not replayed (``span`` counts from their end).
    Simulated: odometry along the true path, with noise of ``odometry_noise`` (m and degrees a
    step, about that of a visual-inertial odometry), and ``outliers``, the share of poses that are
    replaced by others, drawn uniformly from the area and all rotations. Poses are relative to agent
    0's, as in ``stein3d-v0``; the team believes all but the outliers.
    """
    recording = replay.load("murp")
    whole = common_grid(recording, DT, ())
    if not 10.0 <= calibration <= (whole.count - 2) * DT:
        raise ValueError(
            f"calibration={calibration} is not allowed: from 10 s to {(whole.count - 2) * DT:g}"
        )
    steps = round(calibration / DT)
    found = solved(recording, steps)
    grid = replay.cut(Grid(int(whole.times[steps]), DT, whole.count - steps))
    at = np.searchsorted(whole.times, grid.times)
    std, turn_std = found.std, found.turn_std
    if relative_pose_noise is not None:
        std, turn_std = relative_pose_noise[0], math.radians(relative_pose_noise[1])
    odometry, reference = Odometry.of_steps(odometry_noise, DT), Reference()
    matches = RelativePose(len(found.pairs), std, turn_std)
    drawn = RelativePose(len(found.pairs), std, turn_std, outliers)
    poses, there = Series(found.pose[at]), Series(found.there[at])
    measured = RecordedPoses(drawn, found.pairs, poses, there, dict(recording.dropped))
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
