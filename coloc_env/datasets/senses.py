"""Recorded headings, strengths, lamps, distances to walls and fields, as series by step."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from coloc_env.datasets.grid import Grid, last_on
from coloc_env.datasets.noise_model import FieldModel, NoiseModel, StrengthModel
from coloc_env.datasets.recording import Floats, MagneticMap, Recording
from coloc_env.datasets.replay import as_series, dropped_of, newest, once
from coloc_env.motion import Box
from coloc_env.sensors import (
    Compass,
    FieldMap,
    Light,
    Magnetic,
    PathLoss,
    RecordedSensor,
    Rssi,
    Sensor,
    UavRssi,
    Ultrasonic,
)

Read = Callable[[Recording, Grid, Any], RecordedSensor]
_MICRO = 1e6  # µT in a tesla
_FAR = 1e4  # m: what was seen was near enough


def believed_senses(recording: Recording, model: NoiseModel) -> dict[str, tuple[Read, Sensor]]:
    """What reads each of these streams that the recording has, and the belief about its sensor."""
    room = tuple(recording.places.get("room", {}).values())
    own, echo, walls = model.light, model.ultrasonic, _walls(recording)
    made: dict[str, tuple[Read, Callable[[], Sensor]]] = {
        "compass": (recorded_compass, lambda: Compass(model.compass.std)),
        "rssi": (
            recorded_strengths,
            lambda: Rssi(_places(recording, "access_points"), _loss(model.rssi, walls)),
        ),
        "uav_rssi": (recorded_uav_strengths, lambda: UavRssi(_loss(model.uav_rssi, walls))),
        "light": (
            recorded_light,
            lambda: Light(
                _places(recording, "lamps"),
                *(own.power, own.ambient, own.share, own.floor, own.angle_std),
                radius=_FAR,
            ),
        ),
        "ultrasonic": (
            recorded_echoes,
            lambda: Ultrasonic(
                (_tuple(room[0]), _tuple(room[1])), echo.std, echo.reach, 0.0, walls
            ),
        ),
    }
    if recording.magnetic_map is not None:
        known = recording.magnetic_map
        made["magnetometer"] = (recorded_field, lambda: _surveyed(known, model.magnetometer))
    return {
        stream: (read, believed())
        for stream, (read, believed) in made.items()
        if stream in recording.streams
    }


def recorded_compass(recording: Recording, grid: Grid, sensor: Compass) -> RecordedSensor:
    """Leaves ``compass`` and ``compass_mask``: the newest sample of each step."""
    return newest(recording, grid, sensor, "compass")


def recorded_strengths(recording: Recording, grid: Grid, sensor: Rssi) -> RecordedSensor:
    """Leaves ``rssi``, ``rssi_mask`` and ``rssi_map``."""
    values, there = _by_end(recording, grid, "rssi", len(sensor.points))
    return RecordedSensor(
        sensor,
        {"rssi": as_series([v[..., 0] for v in values]), "rssi_mask": as_series(there)},
        {"rssi_map": torch.tensor(sensor.points, dtype=torch.float32).flatten()},
        dropped_of(recording, "rssi"),
    )


def recorded_uav_strengths(recording: Recording, grid: Grid, sensor: UavRssi) -> RecordedSensor:
    """Leaves ``uav_rssi`` and ``uav_rssi_mask``."""
    values, there = _by_end(recording, grid, "uav_rssi", len(recording.robots))
    leaves = {
        "uav_rssi": as_series([v[..., 0] for v in values]),
        "uav_rssi_mask": as_series(there),
    }
    return RecordedSensor(sensor, leaves, dropped=dropped_of(recording, "uav_rssi"))


def recorded_light(recording: Recording, grid: Grid, sensor: Light) -> RecordedSensor:
    """Leaves ``light``, ``light_direction``, ``light_mask`` and ``light_map``."""
    values, there = _by_end(recording, grid, "light", len(sensor.lamps))
    directions = [v[..., 1:].reshape(grid.count, -1) for v in values]
    return RecordedSensor(
        sensor,
        {
            "light": as_series([v[..., 0] for v in values]),
            "light_direction": as_series(directions),
            "light_mask": as_series(there),
        },
        {"light_map": torch.tensor(sensor.lamps, dtype=torch.float32).flatten()},
        dropped_of(recording, "light"),
    )


def recorded_echoes(recording: Recording, grid: Grid, sensor: Ultrasonic) -> RecordedSensor:
    """Leaves ``ultrasonic`` and ``ultrasonic_mask``: the newest sample of each step, of the beams
    that have an echo within reach."""
    values, masks = [], []
    for table in recording.streams["ultrasonic"]:
        seen, there = last_on(grid, table)
        heard = there[:, None] & (seen <= sensor.reach)
        values.append(np.where(heard, seen, 0.0))
        masks.append(heard)
    leaves = {"ultrasonic": as_series(values), "ultrasonic_mask": as_series(masks)}
    return RecordedSensor(sensor, leaves, dropped=dropped_of(recording, "ultrasonic"))


def recorded_field(recording: Recording, grid: Grid, sensor: Magnetic) -> RecordedSensor:
    """Leaves ``magnetic`` (µT) and ``magnetic_mask``: the newest sample of each step."""
    found = [last_on(grid, table) for table in recording.streams["magnetometer"]]
    leaves = {
        "magnetic": as_series([_MICRO * seen for seen, _ in found]),
        "magnetic_mask": as_series([there[:, None] for _, there in found]),
    }
    return RecordedSensor(sensor, leaves, dropped=dropped_of(recording, "magnetometer"))


def _surveyed(known: MagneticMap, model: FieldModel) -> Magnetic:
    """The belief about a magnetometer, with a map."""
    x, y, z = known.axes
    low, high = ((float(x[i]), float(y[i]), float(z[i])) for i in (0, -1))
    dx, dy, dz = (float(np.diff(axis).mean()) if len(axis) > 1 else 1.0 for axis in known.axes)
    values = torch.from_numpy(_MICRO * known.field.reshape(-1, 3))
    survey = FieldMap(low, (len(x), len(y), len(z)), values, (dx, dy, dz))
    own = (model.std, model.anomaly_std, model.length, model.map_std, model.map_time)
    return Magnetic((low, high), *own, survey=survey)


def _by_end(
    recording: Recording, grid: Grid, stream: str, count: int
) -> tuple[list[Floats], list[Any]]:
    """Numbers [T, count, F] by what they are of, and where there are any."""
    tables = recording.streams[stream]
    slots = [table.values[:, 0].astype(np.int64) for table in tables]
    return once(recording, grid, stream, slots, count, slice(1, None))


def _loss(model: StrengthModel, walls: tuple[Box, ...]) -> PathLoss:
    return PathLoss(model.std, model.power, model.exponent, walls, model.wall_loss)


def _walls(recording: Recording) -> tuple[Box, ...]:
    return tuple((_tuple(low), _tuple(high)) for low, high in recording.walls.values())


def _places(recording: Recording, kind: str) -> tuple[tuple[float, ...], ...]:
    return tuple(_tuple(place) for place in recording.places[kind].values())


def _tuple(place: Floats) -> tuple[float, ...]:
    return tuple(place.tolist())
