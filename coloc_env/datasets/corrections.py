"""What takes the systematic errors that a team believes in off its measurements."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from coloc_env.datasets.noise_model import ImuBias, NoiseModel, RangeModel, SightingBias
from coloc_env.datasets.recording import Floats, Recording, Stamps, Table


def corrected(recording: Recording, model: NoiseModel) -> Recording:
    """The recording without the systematic errors that are believed: biases taken off, stamps
    moved to when it was measured, refined places in the map."""
    streams = dict(recording.streams)
    for stream, corrections in stream_corrections(recording, model).items():
        tables = zip(corrections, streams[stream], strict=True)
        streams[stream] = tuple(correct(table) for correct, table in tables)
    anchors, tags = recording.anchors.copy(), recording.tags.copy()
    for name, place in model.anchors.items():
        anchors[recording.anchor_names.index(name)] = place
    for name, arms in model.tags.items():
        tags[recording.robots.index(name), : len(arms)] = arms
    return replace(recording, streams=streams, anchors=anchors, tags=tags)


def stream_corrections(
    recording: Recording, model: NoiseModel
) -> dict[str, tuple[Callable[[Table], Table], ...]]:
    """What takes the systematic errors off each robot's tables, by stream, where there are any."""
    robots, found = recording.robots, dict[str, tuple[Callable[[Table], Table], ...]]()
    for stream, names in (("anchor_ranges", recording.anchor_names), ("uav_ranges", robots)):
        ranges: RangeModel = getattr(model, stream)
        known = [[ranges.of(f"{robot}/{name}") for name in names] for robot in robots]
        bias = np.array([[link.bias for link in own] for own in known])
        late = np.array([[round(link.delay * 1e9) for link in own] for own in known], np.int64)
        if bias.any() or late.any():
            pairs = zip(bias, late, strict=True)
            found[stream] = tuple(partial(_ranges_corrected, bias=b, late=t) for b, t in pairs)
    for stream in ("landmark_bearings", "uav_bearings"):
        own = getattr(model, stream).robots
        off = [own.get(robot, SightingBias()) for robot in robots]
        found[stream] = tuple(partial(_less, bias=(0.0, o.range, o.bearing)) for o in off)
    axes = [model.imu.robots.get(robot, ImuBias()) for robot in robots]
    found["imu"] = tuple(partial(_in_body, off=off) for off in axes)
    found["height"] = (partial(_less, bias=(model.height.bias,)),) * len(robots)
    return {stream: found[stream] for stream in found if stream in recording.streams}


def _ranges_corrected(table: Table, bias: Floats, late: Stamps) -> Table:
    ends = table.values[:, 1].astype(np.int64)
    values = table.values.copy()
    values[:, -1] -= bias[ends]
    there, time = values[:, -1] > 0, table.time - late[ends]
    order = np.argsort(time[there], kind="stable")
    return Table(time[there][order], values[there][order], table.columns)


def _in_body(table: Table, off: ImuBias) -> Table:
    """An IMU without its biases, in the body's axes."""
    if off == ImuBias():
        return table
    axes = Rotation.from_rotvec(off.turn).as_matrix()
    values = table.values - np.array((*off.gyro, *off.accel))
    return replace(table, values=np.hstack((values[:, :3] @ axes, values[:, 3:] @ axes)))


def _less(table: Table, bias: tuple[float, ...]) -> Table:
    return replace(table, values=table.values - np.array(bias)) if any(bias) else table
