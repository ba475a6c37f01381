"""What a loader returns: the ground truth and the sensor streams of one recorded experiment."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]
Flags = NDArray[np.bool_]

FARTHEST = 1e7  # m from the origin: no position on Earth, in whatever map's metres, is beyond
IMU_COLUMNS = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")


class DataError(ValueError):
    """Recorded data that are missing or not what they should be; one line that says where."""


@dataclass(frozen=True, eq=False)
class Track:
    """Ground truth of one robot.

    The attitude is continuous (the heading is unwrapped, successive quaternions lie in one
    hemisphere), so neighbouring samples may be interpolated component by component.

    Attributes:
        time: [T] int64, ns on the recording's common clock, increasing.
        position: [T, d] metres, world frame with z up.
        attitude: [T, 4] unit quaternion wxyz, body to world (d = 3), or [T, 1] heading in rad
            (d = 2).
        velocity: [T, d] m/s in the world frame, None where the recording has none.
        gyro_bias: [T, 3] rad/s in the body frame, None where the recording has none.
        accel_bias: [T, 3] m/s^2 in the body frame, None where the recording has none.

    A robot of which nothing is known has a track without samples (``Track.unknown``).

    Raises:
        ValueError: shapes that do not agree, times that do not increase, or a position that is not
            finite or farther than 10 000 km from the origin.
    """

    time: Stamps
    position: Floats
    attitude: Floats
    velocity: Floats | None = None
    gyro_bias: Floats | None = None
    accel_bias: Floats | None = None

    @classmethod
    def unknown(cls, dim: int) -> "Track":
        """The track of a robot in ``dim`` dimensions without ground truth."""
        attitude = np.empty((0, 1 if dim == 2 else 4))
        return cls(np.empty(0, np.int64), np.empty((0, dim)), attitude)

    def __post_init__(self) -> None:
        steps, dim = self.position.shape
        wanted = {
            "attitude": (steps, 1 if dim == 2 else 4),
            "velocity": (steps, dim),
            "gyro_bias": (steps, 3),
            "accel_bias": (steps, 3),
        }
        for name, shape in wanted.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise ValueError(f"Track.{name} has shape {array.shape}, not {shape}")
        _check_time(self.time, steps, strictly=True)
        check_places("Track.position", self.position)


@dataclass(frozen=True, eq=False)
class Table:
    """One sensor stream of one robot.

    Attributes:
        time: [T] int64, ns on the recording's common clock, never decreasing; samples of one
            burst share their stamp.
        values: [T, F] float64, in the order of ``columns``; indices are whole numbers.
        columns: F names.

    Raises:
        ValueError: shapes that do not agree, or times that decrease.
    """

    time: Stamps
    values: Floats
    columns: tuple[str, ...]

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape[1] != len(self.columns):
            raise ValueError(f"Table has shape {self.values.shape} and columns {self.columns}")
        _check_time(self.time, len(self.values), strictly=False)


@dataclass(frozen=True, eq=False)
class MagneticMap:
    """A magnetic field at the nodes of an even grid.

    Attributes:
        axes: coordinates of the nodes along x, y and z, metres, world frame, increasing.
        field: [X, Y, Z, 3] tesla, world frame.
    """

    axes: tuple[Floats, Floats, Floats]
    field: Floats


@dataclass(frozen=True, eq=False)
class Recording:
    """One recorded experiment of N robots in d dimensions, on one clock.

    Streams, with the columns of their tables (a recording has those it can fill):

    - ``imu``: gyro_x … gyro_z rad/s, accel_x … accel_z specific force m/s^2; forward-left-up body
    - ``odometry``: v m/s, omega rad/s, or vx, vy, omega of a vehicle that also moves sideways; as
      commanded, valid until the next sample
    - ``landmark_bearings``: landmark (index), range m, bearing rad (counter-clockwise)
    - ``uav_bearings``: robot (index), range m, bearing rad
    - ``uav_ranges``: own_tag, robot, tag (indices), range m; each exchange in both ends' tables
    - ``anchor_ranges``: own_tag, anchor (indices), range m
    - ``tdoa``: own_tag, from, to (indices of anchors), difference m: how much farther ``to`` is
    - ``arrival_angles``: robot (index), azimuth rad (counter-clockwise), elevation rad; body frame
    - ``flow``: vx, vy m/s in the body frame
    - ``compass``: heading rad
    - ``rssi``, ``uav_rssi``: point or robot (index), strength dBm
    - ``light``: lamp (index), intensity lx, x, y, z of the lamp's direction in the body frame
    - ``ultrasonic``: forward, back, left, right, up, down m; NaN where there is no echo
    - ``height``: height m above the world's origin
    - ``magnetometer``: x, y, z tesla, body frame
    - ``landmark_vectors``, ``uav_vectors``: landmark or robot (index), x, y, z m in the body frame
    - ``position_fix``: x, y, z m in the world frame
    - ``relative_poses``: robot (index), its x, y, z m and quaternion wxyz (in the plane x, y and
      heading rad) in the body frame

    Attributes:
        name: dataset and sequence.
        dim: d, 2 or 3.
        robots: N names; everywhere else a robot is its index in this tuple.
        truth: one Track per robot.
        streams: stream name to one Table per robot.
        landmarks: [L, d] metres, world frame.
        anchors: [A, d] metres, world frame.
        tags: [N, K, d] lever arms of the ranging tags in the body frame, metres; K = 0 without
            tags, rows of NaN where a robot has fewer than K.
        places: what else is on the map, name to [d] metres, by kind: ``lamps``,
            ``access_points``, and the ``low`` and ``high`` corner of a ``room``.
        walls: name to [2, d] metres: the low and the high corner of a solid box.
        magnetic_map: the magnetic field, None where it is not known.
        source: citation and licence.
        origin: [d] metres: where the origin of all that stands here is in the world frame that was
            recorded.
        dropped: stream name to how many of its measurements were left out, since the sensor cannot
            have given them: not finite, not positive, or beyond its reach.
        landmark_names, anchor_names: L and A names (default: ``landmark_0``, ``anchor_0``, …).
        epoch: ns since 1970 at time zero; 0 where that is not known.
        points: tables of x, y[, z] m, one a robot: places where it was at known times, beside or
            instead of truth; empty without any.
        start: [N, d + a] position and attitude at the start as far as known without truth, NaN
            where not; empty without any.

    Raises:
        ValueError: shapes or numbers of robots that do not agree, or a place that is not finite.
    """

    name: str
    dim: int
    robots: tuple[str, ...]
    truth: tuple[Track, ...]
    streams: Mapping[str, tuple[Table, ...]]
    landmarks: Floats
    anchors: Floats
    tags: Floats
    source: str
    origin: tuple[float, ...] = ()
    dropped: Mapping[str, int] = field(default_factory=dict)
    landmark_names: tuple[str, ...] = ()
    anchor_names: tuple[str, ...] = ()
    epoch: int = 0
    points: tuple[Table, ...] = ()
    start: Floats = field(default_factory=lambda: np.empty((0, 0)))
    places: Mapping[str, Mapping[str, Floats]] = field(default_factory=dict)
    walls: Mapping[str, Floats] = field(default_factory=dict)
    magnetic_map: MagneticMap | None = None

    @property
    def tracked(self) -> bool:
        """Whether every robot has ground truth."""
        return all(len(track.time) for track in self.truth)

    def __post_init__(self) -> None:
        robots = len(self.robots)
        for what in ("landmark", "anchor"):
            places, names = getattr(self, f"{what}s"), getattr(self, f"{what}_names")
            if not names:
                names = tuple(f"{what}_{i}" for i in range(len(places)))
                object.__setattr__(self, f"{what}_names", names)
            if len(names) != len(places):
                raise ValueError(f"Recording.{what}_names are {len(names)}, not {len(places)}")
        marked = {"points": self.points} if self.points else {}
        for what, tables in {"truth": self.truth, **self.streams, **marked}.items():
            if len(tables) != robots:
                raise ValueError(f"Recording.{what} holds {len(tables)} robots, not {robots}")
        if any(track.position.shape[1] != self.dim for track in self.truth):
            raise ValueError(f"Recording.truth is not in {self.dim} dimensions")
        for what, array in {"landmarks": self.landmarks, "anchors": self.anchors}.items():
            if array.ndim != 2 or array.shape[1] != self.dim:
                raise ValueError(f"Recording.{what} has shape {array.shape}, not [n, {self.dim}]")
            check_places(f"Recording.{what}", array)
        for kind, places in self.places.items():
            for name, place in places.items():
                if place.shape != (self.dim,):
                    raise ValueError(f"Recording.places: {kind} {name} has shape {place.shape}")
                check_places(f"Recording.places: {kind} {name}", place)
        for name, corners in self.walls.items():
            if corners.shape != (2, self.dim):
                raise ValueError(f"Recording.walls: {name} has shape {corners.shape}")
            check_places(f"Recording.walls: {name}", corners)
        if self.tags.ndim != 3 or self.tags.shape[::2] != (robots, self.dim):
            raise ValueError(f"Recording.tags has shape {self.tags.shape}, not [{robots}, K, d]")


def plausible(distance: Floats, most: float) -> Flags:
    """Which distances a sensor that reaches ``most`` m can have measured."""
    return np.isfinite(distance) & (distance > 0) & (distance <= most)


def near_origin(recording: Recording) -> Recording:
    """The recording about an origin of its own, the middle of its truth (without any: of its map)
    to the kilometre, so that float32 has digits enough; unchanged where that is within half a
    kilometre of the origin."""
    known = [track.position for track in recording.truth if len(track.time)]
    places = np.concatenate(known or [recording.landmarks, recording.anchors])
    if not len(places):
        return recording
    middle = 0.5 * (places.min(0) + places.max(0))
    origin = 1000.0 * np.round(middle / 1000.0)
    if not origin.any():
        return recording
    dim, streams = recording.dim, dict(recording.streams)
    moved = {"position_fix": origin} | ({"height": origin[2]} if dim == 3 else {})
    for name in moved.keys() & streams.keys():
        streams[name] = _shifted(streams[name], moved[name])
    start = recording.start.copy()
    if len(start):
        start[:, :dim] -= origin
    before = np.array(recording.origin or (0.0,) * dim)
    return replace(
        recording,
        truth=tuple(replace(track, position=track.position - origin) for track in recording.truth),
        streams=streams,
        landmarks=recording.landmarks - origin,
        anchors=recording.anchors - origin,
        origin=tuple((origin + before).tolist()),
        points=_shifted(recording.points, origin),
        start=start,
        places={
            kind: {name: place - origin for name, place in places.items()}
            for kind, places in recording.places.items()
        },
        walls={name: corners - origin for name, corners in recording.walls.items()},
        magnetic_map=_moved(recording.magnetic_map, origin),
    )


def _moved(known: MagneticMap | None, origin: Floats) -> MagneticMap | None:
    if known is None:
        return None
    x, y, z = (axis - start for axis, start in zip(known.axes, origin, strict=True))
    return replace(known, axes=(x, y, z))


def _shifted(tables: tuple[Table, ...], origin: Floats) -> tuple[Table, ...]:
    return tuple(replace(table, values=table.values - origin) for table in tables)


def check_places(what: str, places: Floats) -> None:
    """Raise ValueError for a place that is not finite, or not on Earth."""
    bad = ~(np.abs(places) <= FARTHEST).all(axis=-1)
    if bad.any():
        shown = ", ".join(f"{value:g}" for value in places[bad][0])
        raise DataError(f"{what}: ({shown}) is no place within {FARTHEST:g} m of the origin")


def one_hemisphere(quaternions: Floats) -> Floats:
    """The same rotations [T, 4] with signs such that no two successive ones are opposed."""
    turns = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    signs = np.cumprod(np.where(turns, -1.0, 1.0))
    return np.concatenate((quaternions[:1], quaternions[1:] * signs[:, None]))


def _check_time(time: Stamps, samples: int, *, strictly: bool) -> None:
    if time.dtype != np.int64 or time.shape != (samples,):
        raise ValueError(f"time is {time.dtype}{list(time.shape)}, not int64[{samples}]")
    if samples > 1 and np.any(np.diff(time) < int(strictly)):
        raise ValueError("time does not increase")
