"""Ground truth and marked points of the open format."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from coloc_env.datasets.open_format import frames
from coloc_env.datasets.open_format.columns import Columns, Kind
from coloc_env.datasets.open_format.description import Description
from coloc_env.datasets.recording import (
    FARTHEST,
    DataError,
    Flags,
    Floats,
    Stamps,
    Table,
    Track,
    one_hemisphere,
)

Read = Callable[[Path, Mapping[str, Kind]], Columns]
QUATERNION = ("qx", "qy", "qz", "qw")
AXES = ("x", "y", "z")
GROUPS = {  # optional columns of truth, each group whole or not at all
    "velocity": ("vx", "vy", "vz"),
    "gyro_bias": ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z"),
    "accel_bias": ("accel_bias_x", "accel_bias_y", "accel_bias_z"),
}
_UNIT = 1e-12  # a quaternion's length this close to 1 is left as it is
_MOVING = 0.1  # m/s, above which a course is a direction of travel


def read_truth(path: Path, about: Description, read: Read) -> Track:
    """A robot's positions and, where they stand there, attitudes, velocities and biases of its IMU.

    Without an attitude its place is taken by the course of travel (level, in space).
    """
    dim = about.dim
    axes = AXES[:dim]
    groups = {name: columns[: dim if name == "velocity" else 3] for name, columns in GROUPS.items()}
    turns = QUATERNION if dim == 3 else QUATERNION[2:]
    whole = (*axes, "heading", *turns, *(c for columns in groups.values() for c in columns))
    known: dict[str, Kind] = dict.fromkeys(whole, "number")
    found = _first_of_each(read(path, known))
    if not len(found):
        raise DataError(f"{path}: no data")
    position = frames.world(found.require(*axes) * about.length, about.frame)
    far: Flags = np.abs(position).max(1) > FARTHEST
    if far.any():
        found.fail(far, axes[0], f"is no place within {FARTHEST:g} m of the origin")
    parts = {name: _group(found, columns) for name, columns in groups.items()}
    velocity = parts["velocity"]
    return Track(
        found.time,
        position,
        _attitude(found, about, position),
        None if velocity is None else frames.world(velocity * about.length, about.frame),
        _scaled(parts["gyro_bias"], about, about.angle),
        _scaled(parts["accel_bias"], about, about.acceleration),
    )


def marked_points(path: Path | None, about: Description, read: Read) -> tuple[Table, ...]:
    """Places where robots were at known times: ``stamp, robot, x, y[, z]``."""
    if path is None:
        return ()
    axes = AXES[: about.dim]
    known: dict[str, Kind] = {"robot": "name", **dict.fromkeys(axes, "number")}
    found = read(path, known)
    places = frames.world(found.require(*axes) * about.length, about.frame)
    owner = indices(found, "robot", about.robots)
    tables = []
    for robot in range(len(about.robots)):
        own = owner == robot
        tables.append(Table(found.time[own], places[own], axes))
    return tuple(tables)


def indices(found: Columns, column: str, names: tuple[str, ...]) -> np.ndarray:
    """Where in ``names`` the names of a column are."""
    if column not in found:
        raise DataError(f"{found.path}, line 1: there is no column {column!r}")
    index = {name: i for i, name in enumerate(names)}
    at = np.array([index.get(name, -1) for name in found.names[column]], int)
    if (at < 0).any():
        found.fail(at < 0, column, f"is none of {', '.join(names)}"[:200])
    return at


def _first_of_each(found: Columns) -> Columns:
    """Of samples that share a stamp, the first."""
    fresh = np.diff(found.time, prepend=found.time[:1] - 1) > 0
    return found if fresh.all() else found.rows(fresh)


def _group(found: Columns, columns: tuple[str, ...]) -> Floats | None:
    """All columns of a group, or None if there is none of them."""
    return found.require(*columns) if any(column in found for column in columns) else None


def _scaled(vectors: Floats | None, about: Description, scale: float) -> Floats | None:
    return None if vectors is None else frames.body(vectors * scale, about.frame)


def _attitude(found: Columns, about: Description, position: Floats) -> Floats:
    turned = "qw" in found or "qz" in found
    if turned and "heading" in found:
        raise DataError(f"{found.path}, line 1: both a quaternion and a heading")
    if turned and about.dim == 3:
        q = _quaternions(found)
        return one_hemisphere(frames.attitude(q, about.frame))
    if turned:
        z, w = found.require("qz", "qw").T
        angle = frames.heading(2 * np.arctan2(z, w), about.frame)
    elif "heading" in found:
        angle = frames.heading(found.numbers["heading"] * about.angle, about.frame)
    else:
        angle = course(found.time, position)
    if (np.abs(np.diff(angle)) > np.pi).any():
        angle = np.unwrap(angle)
    if about.dim == 2:
        return angle[:, None]
    zero = np.zeros_like(angle)
    return one_hemisphere(np.stack((np.cos(angle / 2), zero, zero, np.sin(angle / 2)), 1))


def _quaternions(found: Columns) -> Floats:
    """wxyz, of length 1; refused where the length is another one by more than 0.01."""
    q = np.roll(found.require(*QUATERNION), 1, axis=1)
    length = np.linalg.norm(q, axis=1)
    if (bad := np.abs(length - 1) > 0.01).any():
        found.fail(bad, "qw", f"makes a quaternion of length {length[bad][0]:.3f}, not 1")
    loose = np.abs(length - 1) > _UNIT
    q[loose] /= length[loose, None]
    return q


def course(time: Stamps, position: Floats) -> Floats:
    """Direction of travel [T] in the plane, rad; interpolated where the robot stands."""
    if len(time) < 2:
        return np.zeros(len(time))
    velocity = np.gradient(position[:, :2], 1e-9 * time, axis=0)
    moving = np.hypot(*velocity.T) > _MOVING
    if not moving.any():
        return np.zeros(len(time))
    heading = np.unwrap(np.arctan2(velocity[moving, 1], velocity[moving, 0]))
    return np.interp(time, time[moving], heading)
