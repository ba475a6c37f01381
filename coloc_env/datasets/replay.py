"""From a Recording to what a scenario needs: its motion, and its sensors as series by step."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from coloc_env.datasets.grid import (
    Grid,
    Usual,
    bridged,
    held_intervals,
    imu_on,
    last_on,
    odometry_on,
    slots_on,
    truth_on,
    unknown_on,
    usual,
)
from coloc_env.datasets.recording import DataError, Flags, Floats, Recording, Table
from coloc_env.motion import Arena, RecordedMotion
from coloc_env.sensors import (
    AnchorRanging,
    Height,
    Imu,
    LandmarkBearings,
    Landmarks,
    Odometry,
    PositionFix,
    Ranging,
    RecordedImu,
    RecordedOdometry,
    RecordedSensor,
    Sensor,
    UavBearings,
)
from coloc_env.series import Series

_FIX = "position_fix"
_IMU_HELD = 0.1  # s, for which a sample of an IMU stands


def recorded_motion(recording: Recording, grid: Grid) -> RecordedMotion:
    """The team's truth on the grid; steps without truth within 50 ms are not valid.

    A robot without truth stands at its ``start`` (or at zero), never valid but at steps within half
    a step of a marked point, where it is there.
    """
    tracks = [
        truth_on(grid, track) if len(track.time) else _points_on(grid, recording, robot)
        for robot, track in enumerate(recording.truth)
    ]
    position, velocity, attitude, valid = (
        Series(torch.from_numpy(np.stack(parts, 1))) for parts in zip(*tracks, strict=True)
    )
    return RecordedMotion(position, velocity, attitude, valid)


def _points_on(
    grid: Grid, recording: Recording, robot: int
) -> tuple[Floats, Floats, Floats, Flags]:
    """What ``truth_on`` gives, of a robot without truth."""
    dim, times = recording.dim, grid.times
    place, level = np.zeros(dim), np.array((0.0,) if dim == 2 else (1.0, 0.0, 0.0, 0.0))
    if len(recording.start):
        known = recording.start[robot]
        place = np.where(np.isnan(known[:dim]), place, known[:dim])
        level = level if np.isnan(known[dim:]).any() else known[dim:]
    position, attitude = np.tile(place, (grid.count, 1)), np.tile(level, (grid.count, 1))
    valid = np.zeros(grid.count, bool)
    if recording.points:
        marked = recording.points[robot]
        step = np.rint((marked.time - grid.start) / (1e9 * grid.dt)).astype(np.int64)
        inside = (step >= 0) & (step < grid.count)
        near = abs(marked.time - times[step.clip(0, grid.count - 1)]) <= 0.5e9 * grid.dt
        position[step[inside & near]] = marked.values[inside & near]
        valid[step[inside & near]] = True
    return position, np.zeros_like(position), attitude, valid


def arena_of(recording: Recording, grid: Grid, margin: float) -> Arena:
    """The box around everything there is, ``margin`` m wider; where a robot's truth is not known,
    wider by half that box's diagonal, too."""
    dim = recording.dim
    points = [track.position for track in recording.truth]
    points += [p for p in (recording.landmarks, recording.anchors) if len(p)]
    points += [place[None] for places in recording.places.values() for place in places.values()]
    points += recording.walls.values()
    points += [table.values for table in (*recording.points, *recording.streams.get(_FIX, ()))]
    if len(recording.start):
        points.append(recording.start[~np.isnan(recording.start[:, :dim]).any(1), :dim])
    everything = np.concatenate(points)
    if not len(everything):
        everything = np.zeros((1, dim))
    if not recording.tracked:
        margin += 0.5 * float(np.linalg.norm(everything.max(0) - everything.min(0))) + 1.0
    low, high = everything.min(0) - margin, everything.max(0) + margin
    return Arena(
        recording.dim,
        len(recording.robots),
        grid.dt,
        tuple(low.round(2).tolist()),
        tuple(high.round(2).tolist()),
        origin=recording.origin,
        start=recording.epoch + grid.start,
    )


def recorded_imu(
    recording: Recording,
    grid: Grid,
    sensor: Imu,
    bias: Floats,
    like: Sequence[Usual] | None = None,
) -> RecordedImu:
    """Leaf ``imu`` with a calibrated bias (gyro rad/s, accel m/s²; [N, 6]) taken off, and where
    samples are missing leaf ``imu_unknown``. ``like``: what each robot's samples are like (none:
    as those are that are there)."""
    tables = recording.streams["imu"]
    held, unknown = [], []
    for table, own in zip(tables, like or map(usual, tables), strict=True):
        whole, missing = bridged(table, _IMU_HELD, own.mean)
        gyro, accel = np.sqrt(own.variance.reshape(2, 3).mean(1))  # an axis
        held.append(whole)
        unknown.append(unknown_on(grid, missing, np.array((accel, gyro))))
    leaf = imu_on(grid, held, bias[:, :3])
    leaf[..., :3] -= bias[:, 3:]
    series = {"imu": Series(torch.from_numpy(leaf).to(torch.float32))}
    if np.any(unknown):
        series["imu_unknown"] = as_series(unknown)
    return RecordedImu(sensor, series)


def recorded_imu_samples(
    recording: Recording, grid: Grid, sensor: Imu, bias: Floats
) -> RecordedImu:
    """``recorded_imu``, and beside the mean over each step its samples, less their bias."""
    held = [
        held_intervals(grid, bridged(table, _IMU_HELD, table.values.mean(0))[0])
        for table in recording.streams["imu"]
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
    whole = {"imu_samples": as_series(samples), "imu_held": as_series(durations)}
    return RecordedImu(sensor, mean | whole)


def recorded_odometry(
    recording: Recording,
    grid: Grid,
    sensor: Odometry,
    held: float,
    delay: float = 0.0,
    scale: float = 1.0,
    turn_scale: float | None = None,
    like: Sequence[Usual] | None = None,
) -> RecordedOdometry:
    """Leaf ``odometry``: samples that stand for ``held`` s at most, taken to act ``delay`` s later,
    ``scale`` times as strongly (turns: ``turn_scale``, by default the same); and where samples are
    missing leaf ``odometry_unknown``. ``like``: what each robot's samples, as they were read, are
    like (none: as those are that are there)."""
    robots, unknown = [], []
    for robot, table in enumerate(recording.streams["odometry"]):
        factor = np.full(table.values.shape[1], scale)
        if turn_scale is not None:
            factor[-1] = turn_scale
        acting = Table(table.time + round(delay * 1e9), factor * table.values, table.columns)
        if like is None:
            mean, spread = acting.values.mean(0), acting.values.std(0)
        else:
            mean, spread = factor * like[robot].mean, factor * np.sqrt(like[robot].variance)
        whole, missing = bridged(acting, held, mean)
        sideways = spread[1] if len(spread) == 3 else 0.0
        robots.append(odometry_on(grid, whole))
        unknown.append(unknown_on(grid, missing, np.array((spread[0], sideways, spread[-1]))))
    series = {"odometry": as_series(robots)}
    if np.any(unknown):
        series["odometry_unknown"] = as_series(unknown)
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
        f"{name}s": as_series([v.reshape(grid.count, -1) for v in values]),
        f"{name}_mask": as_series([m.reshape(grid.count, -1) for m in there]),
    }
    maps = {}
    if to_landmarks:
        maps["landmark_map"] = torch.from_numpy(recording.landmarks.ravel()).to(torch.float32)
    dropped = dropped_of(recording, stream)
    return RecordedSensor(sensor, series, maps, dropped), depth


def recorded_ranges(recording: Recording, grid: Grid, sensor: Ranging) -> RecordedSensor:
    """Leaves ``ranges`` and ``range_mask``: entry (robot · T + own tag) · T + their tag."""
    tags, robots = sensor.n_tags, len(recording.robots)
    slots = [
        ((t.values[:, 1] * tags + t.values[:, 0]) * tags + t.values[:, 2]).astype(np.int64)
        for t in recording.streams["uav_ranges"]
    ]
    ranges, there = _ranges(recording, grid, "uav_ranges", slots, robots * tags**2, slice(3, 4))
    dropped = dropped_of(recording, "uav_ranges")
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
    dropped = dropped_of(recording, "anchor_ranges")
    return RecordedSensor(sensor, leaves, maps, dropped)


def recorded_height(recording: Recording, grid: Grid, sensor: Height) -> RecordedSensor:
    """Leaves ``height`` and ``height_mask``: the newest sample of each step."""
    return newest(recording, grid, sensor, "height")


def recorded_landmarks(recording: Recording, grid: Grid, sensor: Landmarks) -> RecordedSensor:
    """Leaves ``landmarks`` and ``landmark_mask``: vectors to landmarks in the body frame."""
    slots = [t.values[:, 0].astype(np.int64) for t in recording.streams["landmark_vectors"]]
    count, dim = len(recording.landmarks), recording.dim
    values, there = once(recording, grid, "landmark_vectors", slots, count, slice(1, 1 + dim))
    return RecordedSensor(
        sensor,
        {
            "landmarks": as_series([each.reshape(grid.count, -1) for each in values]),
            "landmark_mask": as_series(there),
        },
        {"landmark_map": torch.from_numpy(recording.landmarks.ravel()).to(torch.float32)},
        dropped_of(recording, "landmark_vectors"),
    )


def recorded_fixes(recording: Recording, grid: Grid, sensor: PositionFix) -> RecordedSensor:
    """Leaves ``position_fix`` and ``position_fix_mask``: the newest sample of each step."""
    return newest(recording, grid, sensor, "position_fix")


def lever_arms(recording: Recording) -> tuple[tuple[tuple[float, ...], ...], ...]:
    """Tags of every robot as a sensor's setting; all robots must carry equally many."""
    if np.isnan(recording.tags).any():
        raise DataError(f"{recording.name}: its robots carry different numbers of tags")
    return tuple(tuple(tuple(arm) for arm in robot) for robot in recording.tags.tolist())


def dropped_of(recording: Recording, stream: str) -> dict[str, int]:
    """How many of a stream's measurements were left out, as ``RecordedSensor`` has it."""
    return {stream: recording.dropped.get(stream, 0)}


def newest(recording: Recording, grid: Grid, sensor: Sensor, stream: str) -> RecordedSensor:
    """A stream's own leaf and its mask, with the newest sample of each step."""
    tables = [last_on(grid, table) for table in recording.streams[stream]]
    return RecordedSensor(
        sensor,
        {
            stream: as_series([values for values, _ in tables]),
            f"{stream}_mask": as_series([there[:, None] for _, there in tables]),
        },
        dropped=dropped_of(recording, stream),
    )


def _ranges(
    recording: Recording,
    grid: Grid,
    stream: str,
    slots: Sequence[np.ndarray],
    count: int,
    columns: slice,
) -> tuple[Series, Series]:
    values, there = once(recording, grid, stream, slots, count, columns)
    return as_series([each[..., 0] for each in values]), as_series(there)


def once(
    recording: Recording,
    grid: Grid,
    stream: str,
    slots: Sequence[np.ndarray],
    count: int,
    columns: slice,
) -> tuple[list[Floats], list[Flags]]:
    """Measurements [T, count, F] of each robot and their masks; DataError where a step would have
    to deliver two of one slot."""
    values, there = [], []
    for table, slot in zip(recording.streams[stream], slots, strict=True):
        seen, mask = slots_on(grid, table, slot, count, columns)
        if mask.shape[1] > 1:
            raise DataError(
                f"{recording.name}: {stream} deliver one pair twice within {grid.dt} s; "
                "choose a smaller dt"
            )
        values.append(seen[:, 0])
        there.append(mask[:, 0])
    return values, there


def as_series(robots: Sequence[np.ndarray]) -> Series:
    """One leaf of all robots, [T, N, F] float32."""
    stacked: Tensor = torch.from_numpy(np.stack(robots, 1)).to(torch.float32)
    return Series(stacked)
