"""From a Recording to what a scenario needs: its motion, and its sensors as series by step."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from coloc_env.datasets.grid import (
    Grid,
    bridged,
    held_intervals,
    imu_on,
    last_on,
    odometry_on,
    slots_on,
    truth_on,
    unknown_on,
)
from coloc_env.datasets.recording import DataError, Floats, Recording, Table
from coloc_env.motion import Arena, RecordedMotion
from coloc_env.sensors import (
    AnchorRanging,
    Height,
    Imu,
    LandmarkBearings,
    Odometry,
    Ranging,
    RecordedImu,
    RecordedOdometry,
    RecordedSensor,
    UavBearings,
)
from coloc_env.series import Series

_IMU_HELD = 0.1  # s, for which a sample of an IMU stands


def recorded_motion(recording: Recording, grid: Grid) -> RecordedMotion:
    """The team's truth on the grid; steps without truth within 50 ms are not valid."""
    tracks = [truth_on(grid, track) for track in recording.truth]
    position, velocity, attitude, valid = (
        Series(torch.from_numpy(np.stack(parts, 1))) for parts in zip(*tracks, strict=True)
    )
    return RecordedMotion(position, velocity, attitude, valid)


def arena_of(recording: Recording, grid: Grid, margin: float) -> Arena:
    """The box around everything there is, ``margin`` m wider."""
    points = [track.position for track in recording.truth]
    points += [p for p in (recording.landmarks, recording.anchors) if len(p)]
    everything = np.concatenate(points)
    low, high = everything.min(0) - margin, everything.max(0) + margin
    return Arena(
        recording.dim,
        len(recording.robots),
        grid.dt,
        tuple(low.round(2).tolist()),
        tuple(high.round(2).tolist()),
        origin=recording.origin,
    )


def recorded_imu(recording: Recording, grid: Grid, sensor: Imu, bias: Floats) -> RecordedImu:
    """Leaf ``imu`` with a calibrated bias (gyro rad/s, accel m/s²; [N, 6]) taken off, and where
    samples are missing leaf ``imu_unknown``."""
    robots, unknown = [], []
    for table, own in zip(recording.streams["imu"], bias, strict=True):
        whole, missing = bridged(table, _IMU_HELD)
        gyro, accel = np.sqrt(table.values.var(0).reshape(2, 3).mean(1))  # an axis
        leaf = imu_on(grid, whole, own[:3])
        leaf[:, :3] -= own[3:]
        robots.append(leaf)
        unknown.append(unknown_on(grid, missing, np.array((accel, gyro))))
    series = {"imu": _series(robots)}
    if np.any(unknown):
        series["imu_unknown"] = _series(unknown)
    return RecordedImu(sensor, series)


def recorded_imu_samples(
    recording: Recording, grid: Grid, sensor: Imu, bias: Floats
) -> RecordedImu:
    """``recorded_imu``, and beside the mean over each step its samples, less their bias."""
    held = [
        held_intervals(grid, bridged(table, _IMU_HELD)[0]) for table in recording.streams["imu"]
    ]
    width = max(durations.shape[1] for _, durations in held)
    samples, durations = [], []
    for (values, lasting), own in zip(held, bias, strict=True):
        there = (lasting > 0)[..., None]
        forces = np.concatenate((values[..., 3:] - own[3:], values[..., :3] - own[:3]), -1) * there
        pad = ((0, 0), (0, width - lasting.shape[1]))
        samples.append(np.pad(forces, (*pad, (0, 0))).reshape(grid.count, -1))
        durations.append(np.pad(lasting, pad))
    mean = recorded_imu(recording, grid, sensor, bias).series
    whole = {"imu_samples": _series(samples), "imu_held": _series(durations)}
    return RecordedImu(sensor, mean | whole)


def recorded_odometry(
    recording: Recording,
    grid: Grid,
    sensor: Odometry,
    held: float,
    delay: float = 0.0,
    scale: float = 1.0,
) -> RecordedOdometry:
    """Leaf ``odometry``: samples that stand for ``held`` s at most, taken to act ``delay`` s later,
    ``scale`` times as strongly; and where samples are missing leaf ``odometry_unknown``."""
    robots, unknown = [], []
    for table in recording.streams["odometry"]:
        acting = Table(table.time + round(delay * 1e9), scale * table.values, table.columns)
        whole, missing = bridged(acting, held)
        speed, turn = acting.values.std(0)
        robots.append(odometry_on(grid, whole))
        unknown.append(unknown_on(grid, missing, np.array((speed, 0.0, turn))))
    series = {"odometry": _series(robots)}
    if np.any(unknown):
        series["odometry_unknown"] = _series(unknown)
    return RecordedOdometry(sensor, series)


def recorded_bearings(
    recording: Recording, grid: Grid, sensor: LandmarkBearings | UavBearings
) -> tuple[RecordedSensor, int]:
    """Leaves of range and bearing to landmarks or robots, and the depth that they need."""
    to_landmarks = isinstance(sensor, LandmarkBearings)
    stream = "landmark_bearings" if to_landmarks else "uav_bearings"
    name = "landmark_bearing" if to_landmarks else "uav_bearing"
    count = len(recording.landmarks) if to_landmarks else len(recording.robots)
    values, there = [], []
    for table in recording.streams[stream]:
        seen, mask = slots_on(grid, table, table.values[:, 0].astype(np.int64), count, slice(1, 3))
        values.append(seen)
        there.append(mask)
    depth = max(mask.shape[1] for mask in there)
    pad = [((0, 0), (0, depth - mask.shape[1]), (0, 0)) for mask in there]
    values = [np.pad(v, (*p, (0, 0))) for v, p in zip(values, pad, strict=True)]
    there = [np.pad(m, p) for m, p in zip(there, pad, strict=True)]
    series = {
        f"{name}s": _series([v.reshape(grid.count, -1) for v in values]),
        f"{name}_mask": _series([m.reshape(grid.count, -1) for m in there]),
    }
    maps = {}
    if to_landmarks:
        maps["landmark_map"] = torch.from_numpy(recording.landmarks.ravel()).to(torch.float32)
    dropped = {stream: recording.dropped.get(stream, 0)}
    return RecordedSensor(sensor, series, maps, dropped), depth


def recorded_ranges(recording: Recording, grid: Grid, sensor: Ranging) -> RecordedSensor:
    """Leaves ``ranges`` and ``range_mask``: entry (robot · T + own tag) · T + their tag."""
    tags, robots = sensor.n_tags, len(recording.robots)
    slots = [
        ((t.values[:, 1] * tags + t.values[:, 0]) * tags + t.values[:, 2]).astype(np.int64)
        for t in recording.streams["uav_ranges"]
    ]
    ranges, there = _ranges(recording, grid, "uav_ranges", slots, robots * tags**2, slice(3, 4))
    dropped = {"uav_ranges": recording.dropped.get("uav_ranges", 0)}
    return RecordedSensor(sensor, {"ranges": ranges, "range_mask": there}, dropped=dropped)


def recorded_anchor_ranges(
    recording: Recording, grid: Grid, sensor: AnchorRanging
) -> RecordedSensor:
    """Leaves ``anchor_ranges`` and ``anchor_range_mask``: entry own tag · A + anchor."""
    anchors = len(recording.anchors)
    slots = [
        (t.values[:, 0] * anchors + t.values[:, 1]).astype(np.int64)
        for t in recording.streams["anchor_ranges"]
    ]
    count = anchors * sensor.n_tags
    ranges, there = _ranges(recording, grid, "anchor_ranges", slots, count, slice(2, 3))
    maps = {"anchor_map": torch.from_numpy(recording.anchors.ravel()).to(torch.float32)}
    leaves = {"anchor_ranges": ranges, "anchor_range_mask": there}
    dropped = {"anchor_ranges": recording.dropped.get("anchor_ranges", 0)}
    return RecordedSensor(sensor, leaves, maps, dropped)


def recorded_height(recording: Recording, grid: Grid, sensor: Height) -> RecordedSensor:
    """Leaves ``height`` and ``height_mask``: the newest sample of each step."""
    tables = [last_on(grid, table) for table in recording.streams["height"]]
    return RecordedSensor(
        sensor,
        {
            "height": _series([values for values, _ in tables]),
            "height_mask": _series([there[:, None] for _, there in tables]),
        },
        dropped={"height": recording.dropped.get("height", 0)},
    )


def lever_arms(recording: Recording) -> tuple[tuple[tuple[float, ...], ...], ...]:
    """Tags of every robot as a sensor's setting; all robots must carry equally many."""
    if np.isnan(recording.tags).any():
        raise DataError(f"{recording.name}: its robots carry different numbers of tags")
    return tuple(tuple(tuple(arm) for arm in robot) for robot in recording.tags.tolist())


def _ranges(
    recording: Recording,
    grid: Grid,
    stream: str,
    slots: Sequence[np.ndarray],
    count: int,
    columns: slice,
) -> tuple[Series, Series]:
    values, there = [], []
    for table, slot in zip(recording.streams[stream], slots, strict=True):
        seen, mask = slots_on(grid, table, slot, count, columns)
        if mask.shape[1] > 1:
            raise DataError(
                f"{recording.name}: {stream} deliver one pair twice within {grid.dt} s; "
                "choose a smaller dt"
            )
        values.append(seen[:, 0, :, 0])
        there.append(mask[:, 0])
    return _series(values), _series(there)


def _series(robots: Sequence[np.ndarray]) -> Series:
    """One leaf of all robots, [T, N, F] float32."""
    stacked: Tensor = torch.from_numpy(np.stack(robots, 1)).to(torch.float32)
    return Series(stacked)
