"""Sensor streams of the open format: which columns each table has, and what becomes of them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_env.datasets.open_format import carried, frames, senses
from coloc_env.datasets.open_format.carried import REACH, Made, tags_of
from coloc_env.datasets.open_format.columns import Columns, Kind
from coloc_env.datasets.open_format.description import Description
from coloc_env.datasets.open_format.truth import AXES, QUATERNION, indices
from coloc_env.datasets.recording import (
    FARTHEST,
    IMU_COLUMNS,
    DataError,
    Flags,
    Floats,
    Recording,
    Stamps,
    Table,
    plausible,
)

Read = Callable[[Path, Mapping[str, Kind]], Columns]
Find = Callable[[Path, str], Path | None]


@dataclass(frozen=True)
class _File:
    """The columns of a kind of table, and what makes streams of it: tables of one robot, and how
    many measurements were left out."""

    columns: Mapping[str, Kind]
    make: Callable[[Columns, Description], Made]


def read_streams(
    folder: Path, about: Description, read: Read, find: Find
) -> tuple[dict[str, tuple[Table, ...]], dict[str, int]]:
    """Every stream that a robot has a table for, and what was left out of each."""
    made: list[Made] = []
    for robot in about.robots:
        own: Made = {}
        for stem, kind in FILES.items():
            path = find(folder / robot, stem)
            if path is not None:
                own |= kind.make(read(path, kind.columns), about)
        made.append(own)
    names = [name for name in ORDER if any(name in own for own in made)]
    dropped = {name: sum(own[name][1] for own in made if name in own) for name in names}
    team = {
        name: tuple(own[name][0] if name in own else _empty(name, made) for own in made)
        for name in names
    }
    if about.once and "uav_ranges" in team:
        team["uav_ranges"] = _known_to_both(team["uav_ranges"])
    return team, {name: count for name, count in dropped.items() if count}


def in_body(arms: Floats, frame: str) -> Floats:
    """Lever arms in our body frame."""
    return frames.body(arms, frame)


def start_in_world(about: Description) -> Floats:
    """Starts [N, d + a] in our frames."""
    start, dim = about.start, about.dim
    if not len(start):
        return start
    turned = start[:, dim:]
    turned = (
        frames.heading(turned, about.frame) if dim == 2 else frames.attitude(turned, about.frame)
    )
    return np.concatenate((frames.world(start[:, :dim], about.frame), turned), 1)


def places_in_world(about: Description) -> dict[str, dict[str, Floats]]:
    """What else is on the map in our frames; kinds of which there is none are not there."""
    found = {
        kind: {name: frames.world(place, about.frame) for name, place in places.items()}
        for kind, places in about.places.items()
        if places
    }
    if "room" in found:
        found["room"] = senses.room_of(found["room"])
    return found


def walls_in_world(about: Description) -> dict[str, Floats]:
    """Low and high corners [2, d] of walls in our frames."""
    both = {name: frames.world(corners, about.frame) for name, corners in about.walls.items()}
    return {name: np.stack((each.min(0), each.max(0))) for name, each in both.items()}


# ------------------------------------------------------------------ one table


def _imu(found: Columns, about: Description) -> Made:
    values = found.require(*IMU_COLUMNS)
    gyro = frames.body(values[:, :3] * about.angle, about.frame)
    accel = frames.body(values[:, 3:] * about.acceleration, about.frame)
    return {"imu": (Table(found.time, np.concatenate((gyro, accel), 1), IMU_COLUMNS), 0)}


def _odometry(found: Columns, about: Description) -> Made:
    """``v, omega`` or ``vx, vy[, vz], wz``."""
    if ("v" in found) == ("vx" in found):
        raise DataError(f"{found.path}, line 1: either v and omega are needed, or vx, vy and wz")
    if "v" in found:
        speed, rate = found.require("v") * about.length, found.require("omega")
        columns: tuple[str, ...] = ("v", "omega")
    else:
        speed, rate = found.require("vx", "vy") * about.length, found.require("wz")
        speed = frames.body(speed, about.frame)
        columns = ("vx", "vy", "omega")
    values = np.concatenate((speed, frames.turn(rate * about.angle, about.frame)), 1)
    return {"odometry": (Table(found.time, values, columns), 0)}


def _ranges(found: Columns, about: Description) -> Made:
    ends = (*about.robots, *about.anchors)
    to = indices(found, "to", ends)
    if (own := to == about.robots.index(found.path.parent.name)).any():
        found.fail(own, "to", "is the robot itself")
    distance = found.require("range")[:, 0] * about.length
    tags = [tags_of(found, about, column) for column in ("own_tag", "to_tag")]
    good = plausible(distance, REACH)
    robots, made = len(about.robots), Made()
    for name, among in (("uav_ranges", to < robots), ("anchor_ranges", to >= robots)):
        there = among & good
        if name == "uav_ranges":
            columns: tuple[str, ...] = ("own_tag", "robot", "tag", "range")
            values = np.column_stack((tags[0], to, tags[1], distance))
        else:
            columns = ("own_tag", "anchor", "range")
            values = np.column_stack((tags[0], to - robots, distance))
        if among.any():
            table = Table(found.time[there], values[there], columns)
            made[name] = (table, int((among & ~good).sum()))
    return made


def _sightings(found: Columns, about: Description) -> Made:
    """Landmarks or robots, as range and bearing or as a vector in the body frame."""
    seen = _seen(found, about)
    if "range" in found or "bearing" in found:
        kind, columns, values, good = _bearings(found, about)
    else:
        kind, columns, values, good = _vectors(found, about)
    robots, made = len(about.robots), Made()
    for what, among, first in (("landmark", seen >= robots, robots), ("uav", seen < robots, 0)):
        if among.any():
            there, name = among & good, "landmark" if what == "landmark" else "robot"
            rows: Floats = np.column_stack((seen[there] - first, values[there]))
            table = Table(found.time[there], rows, (name, *columns))
            made[f"{what}_{kind}"] = (table, int((among & ~good).sum()))
    return made


def _seen(found: Columns, about: Description) -> NDArray[np.int64]:
    """What each row [T] is a sighting of: robots by their indices, landmarks after them."""
    robots, landmarks = (
        found.names.get(column, [""] * len(found)) for column in ("robot", "landmark")
    )
    if not found.names:
        raise DataError(f"{found.path}, line 1: there is no column 'landmark' or 'robot'")
    for column, other in (("robot", landmarks), ("landmark", robots)):
        if column in found.names:
            names = found.names[column]
            both = np.array([bool(a) and bool(b) for a, b in zip(names, other, strict=True)], bool)
            if both.any():
                found.fail(both, column, "and a landmark or robot in one row")
            neither = np.array([not a and not b for a, b in zip(names, other, strict=True)], bool)
            if neither.any():
                found.fail(neither, column, "names no landmark and no robot")
    whole = replace(found, names={"of": [a or b for a, b in zip(robots, landmarks, strict=True)]})
    seen = indices(whole, "of", (*about.robots, *about.landmarks))
    count, own = len(about.robots), about.robots.index(found.path.parent.name)
    named = np.array([bool(name) for name in robots], bool)
    for column, bad, reason in (
        ("robot", named & (seen >= count), "is no robot"),
        ("landmark", ~named & (seen < count), "is no landmark"),
        ("robot", named & (seen == own), "is the robot itself"),
    ):
        if bad.any():
            found.fail(bad, column, reason)
    return seen


def _bearings(found: Columns, about: Description) -> tuple[str, tuple[str, ...], Floats, Flags]:
    if about.dim == 3:
        raise DataError(
            f"{found.path}, line 1: range and bearing are for 2 dimensions; use x, y, z"
        )
    values = found.require("range", "bearing") * (about.length, about.angle)
    values[:, 1] = frames.turn(values[:, 1], about.frame)
    wide = np.isfinite(values[:, 1]) & (np.abs(values[:, 1]) > 2 * np.pi)
    if wide.any():
        found.fail(wide, "bearing", "is more than a whole turn: see units.angle")
    over = np.abs(values[:, 1]) > np.pi
    values[over, 1] = (values[over, 1] + np.pi) % (2 * np.pi) - np.pi
    good = plausible(values[:, 0], REACH) & np.isfinite(values[:, 1])
    return "bearings", ("range", "bearing"), values, good


def _vectors(found: Columns, about: Description) -> tuple[str, tuple[str, ...], Floats, Flags]:
    axes = AXES[: about.dim]
    vectors = frames.body(found.require(*axes) * about.length, about.frame)
    good = plausible(np.linalg.norm(vectors, axis=1), REACH)
    if about.dim == 3:
        return "vectors", axes, vectors, good
    flat = np.stack((np.hypot(*vectors.T), np.arctan2(vectors[:, 1], vectors[:, 0])), 1)
    return "bearings", ("range", "bearing"), flat, good


def _height(found: Columns, about: Description) -> Made:
    if about.dim == 2:
        raise DataError(f"{found.path}: a height is for 3 dimensions")
    sign = -1.0 if about.frame == "ned" and "z" in found else 1.0
    height: Floats = sign * about.length * found.require("z" if "z" in found else "height")
    good = np.abs(height[:, 0]) <= FARTHEST
    return {"height": (Table(found.time[good], height[good], ("height",)), int((~good).sum()))}


def _fixes(found: Columns, about: Description) -> Made:
    axes = AXES[: about.dim]
    places = frames.world(found.require(*axes) * about.length, about.frame)
    good = (np.abs(places) <= FARTHEST).all(1)
    return {"position_fix": (Table(found.time[good], places[good], axes), int((~good).sum()))}


def _magnetometer(found: Columns, about: Description) -> Made:
    field = frames.body(found.require(*AXES), about.frame)
    return {"magnetometer": (Table(found.time, field, AXES), 0)}


def _poses(found: Columns, about: Description) -> Made:
    dim = about.dim
    robot = indices(found, "robot", about.robots)
    place = frames.body(found.require(*AXES[:dim]) * about.length, about.frame)
    if dim == 2:
        turned = frames.turn(found.require("heading") * about.angle, about.frame)
        columns: tuple[str, ...] = ("robot", "x", "y", "heading")
    else:
        q = np.roll(found.require(*QUATERNION), 1, axis=1)
        length = np.linalg.norm(q, axis=1)
        if (bad := np.abs(length - 1) > 0.01).any():
            found.fail(bad, "qw", f"makes a quaternion of length {length[bad][0]:.3f}, not 1")
        loose = np.abs(length - 1) > 1e-12
        q[loose] /= length[loose, None]
        turned = q * (1, 1, -1, -1) if about.frame == "ned" else q
        columns = ("robot", *AXES, "qw", "qx", "qy", "qz")
    values = np.column_stack((robot, place, turned))
    return {"relative_poses": (Table(found.time, values, columns), 0)}


# ------------------------------------------------------------------ the team


def _empty(name: str, made: list[Made]) -> Table:
    """The table of a robot that has none of a stream."""
    columns = next(own[name][0].columns for own in made if name in own)
    return Table(np.empty(0, np.int64), np.empty((0, len(columns))), columns)


def _known_to_both(tables: tuple[Table, ...]) -> tuple[Table, ...]:
    """Each exchange in both ends' tables, whoever wrote it down; the very same one once."""
    rows: list[list[tuple[Stamps, Floats]]] = [[] for _ in tables]
    for robot, table in enumerate(tables):
        rows[robot].append((table.time, table.values))
        for other in np.unique(table.values[:, 1]).astype(int):
            there = table.values[:, 1] == other
            rows[other].append((table.time[there], seen_back(table.values[there], robot)))
    found = []
    for table, mine in zip(tables, rows, strict=True):
        time = np.concatenate([each for each, _ in mine])
        values = np.concatenate([each for _, each in mine])
        order = np.argsort(time, kind="stable")
        time, values = time[order], values[order]
        if len(mine) > 1:
            keys = np.column_stack((time, values.view(np.int64)))
            first = np.sort(np.unique(keys, axis=0, return_index=True)[1])
            time, values = time[first], values[first]
        found.append(Table(time, values, table.columns))
    return tuple(found)


def seen_back(values: Floats, robot: int) -> Floats:
    """Rows of a robot's ``uav_ranges`` as the other end has them."""
    own_tag, _, tag, distance = values.T
    return np.column_stack((tag, np.full(len(tag), float(robot)), own_tag, distance))


def _kinds(kind: Kind, *names: str) -> dict[str, Kind]:
    return dict.fromkeys(names, kind)


FILES: dict[str, _File] = {
    "imu": _File(_kinds("number", *IMU_COLUMNS), _imu),
    "odometry": _File(_kinds("number", "v", "omega", "vx", "vy", "wz"), _odometry),
    "ranges": _File(
        _kinds("name", "to") | _kinds("measured", "range") | _kinds("number", "own_tag", "to_tag"),
        _ranges,
    ),
    "sightings": _File(
        _kinds("name", "landmark", "robot") | _kinds("measured", "x", "y", "z", "range", "bearing"),
        _sightings,
    ),
    "height": _File(_kinds("measured", "height", "z"), _height),
    "position_fix": _File(_kinds("measured", *AXES), _fixes),
    "tdoa": _File(
        _kinds("name", "from", "to")
        | _kinds("measured", "difference")
        | _kinds("number", "own_tag"),
        carried.differences,
    ),
    "angles": _File(
        _kinds("name", "robot") | _kinds("measured", "azimuth", "elevation"), carried.angles
    ),
    "flow": _File(_kinds("measured", "vx", "vy"), carried.flow),
    "compass": _File(_kinds("measured", "heading"), senses.compass),
    "rssi": _File(_kinds("name", "to") | _kinds("measured", "strength"), senses.strengths),
    "light": _File(_kinds("name", "lamp") | _kinds("measured", "intensity", *AXES), senses.light),
    "ultrasonic": _File(_kinds("measured", *senses.BEAMS), senses.echoes),
    "magnetometer": _File(_kinds("number", *AXES), _magnetometer),
    "relative_pose": _File(
        _kinds("name", "robot") | _kinds("number", *AXES, *QUATERNION, "heading"), _poses
    ),
}
ORDER = (
    "imu", "odometry", "landmark_bearings", "uav_bearings", "landmark_vectors", "uav_vectors",
    "uav_ranges", "anchor_ranges", "tdoa", "arrival_angles", "height", "position_fix", "flow",
    "compass", "rssi", "uav_rssi", "light", "ultrasonic", "magnetometer", "relative_poses",
)  # fmt: skip


def stream_files(recording: Recording) -> dict[str, tuple[str, ...]]:
    """Which streams of a recording go into which table."""
    files = {
        "imu": ("imu",),
        "odometry": ("odometry",),
        "ranges": ("uav_ranges", "anchor_ranges"),
        "sightings": ("landmark_bearings", "uav_bearings", "landmark_vectors", "uav_vectors"),
        "height": ("height",),
        "position_fix": ("position_fix",),
        "tdoa": ("tdoa",),
        "angles": ("arrival_angles",),
        "flow": ("flow",),
        "compass": ("compass",),
        "rssi": ("rssi", "uav_rssi"),
        "light": ("light",),
        "ultrasonic": ("ultrasonic",),
        "magnetometer": ("magnetometer",),
        "relative_pose": ("relative_poses",),
    }
    return {
        file: having
        for file, names in files.items()
        if (having := tuple(name for name in names if name in recording.streams))
    }
