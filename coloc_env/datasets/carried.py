"""Recorded time differences, angles of arrival and optical flow, as series by step."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from coloc_env.datasets.grid import Grid, slots_on
from coloc_env.datasets.recording import Recording, Table
from coloc_env.datasets.replay import as_series, newest
from coloc_env.sensors import ArrivalAngles, OpticalFlow, RecordedSensor, Tdoa
from coloc_env.sensors.ranging import Tags

_S = TypeVar("_S", Tdoa, ArrivalAngles)


def believed_tdoa(recording: Recording, std: float, tags: Tags) -> Tdoa:
    """The belief about a recording's time differences: of any two of its anchors."""
    places = tuple(map(tuple, recording.anchors.tolist()))
    return Tdoa(places, std, tags, tuple(combinations(range(len(places)), 2)))


def recorded_tdoa(recording: Recording, grid: Grid, sensor: Tdoa) -> tuple[RecordedSensor, Tdoa]:
    """Leaves ``tdoa`` and ``tdoa_mask``, and the belief with the depth that they need; a difference
    between two anchors the other way round has the other sign."""
    pairs, anchors = np.array(sensor.pairs), len(sensor.anchors)
    index = np.zeros((anchors, anchors), np.int64)
    index[pairs[:, 0], pairs[:, 1]] = index[pairs[:, 1], pairs[:, 0]] = np.arange(len(pairs))
    tables, slots = [], []
    for table in recording.streams["tdoa"]:
        tag, m, n = table.values[:, :3].astype(np.int64).T
        sign = np.where(m < n, 1.0, -1.0)
        slots.append(tag * len(pairs) + index[m, n])
        tables.append(Table(table.time, (sign * table.values[:, 3])[:, None], ("difference",)))
    count = sensor.n_tags * len(pairs)
    leaves, deep = _deep(grid, sensor, tables, slots, count, ("tdoa", "tdoa_mask"))
    maps = {"tdoa_map": torch.from_numpy(recording.anchors.ravel()).to(torch.float32)}
    dropped = {"tdoa": recording.dropped.get("tdoa", 0)}
    return replace(leaves, maps=maps, dropped=dropped), deep


def recorded_angles(
    recording: Recording, grid: Grid, sensor: ArrivalAngles
) -> tuple[RecordedSensor, ArrivalAngles]:
    """Leaves ``arrival_angles`` and ``arrival_angle_mask``, and the belief with the depth that they
    need."""
    team = recording.streams["arrival_angles"]
    tables = [Table(t.time, t.values[:, 1:], t.columns[1:]) for t in team]
    slots = [t.values[:, 0].astype(np.int64) for t in team]
    names = ("arrival_angles", "arrival_angle_mask")
    leaves, deep = _deep(grid, sensor, tables, slots, len(recording.robots), names)
    dropped = {"arrival_angles": recording.dropped.get("arrival_angles", 0)}
    return replace(leaves, dropped=dropped), deep


def recorded_flow(recording: Recording, grid: Grid, sensor: OpticalFlow) -> RecordedSensor:
    """Leaves ``flow`` and ``flow_mask``: the newest sample of each step."""
    return newest(recording, grid, sensor, "flow")


def _deep(
    grid: Grid,
    sensor: _S,
    tables: Sequence[Table],
    slots: Sequence[NDArray[np.int64]],
    count: int,
    names: tuple[str, str],
) -> tuple[RecordedSensor, _S]:
    """Measurements and their mask under two names, as deep as one step ever delivers a slot."""
    pairs = zip(tables, slots, strict=True)
    team = [slots_on(grid, table, slot, count, slice(None)) for table, slot in pairs]
    depth = max(there.shape[1] for _, there in team)
    values, masks = [], []
    for seen, there in team:
        missing = (0, depth - there.shape[1])
        none = (0, 0)
        values.append(np.pad(seen, (none, missing, none, none)).reshape(grid.count, -1))
        masks.append(np.pad(there, (none, missing, none)).reshape(grid.count, -1))
    deep = replace(sensor, depth=depth)
    leaves = {names[0]: as_series(values), names[1]: as_series(masks)}
    return RecordedSensor(deep, leaves), deep
