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
class Recording:
    """One recorded experiment of N robots in d dimensions, on one clock.

    Streams, with the columns of their tables (a recording has those it can fill):

    - ``imu``: gyro_x … gyro_z rad/s, accel_x … accel_z specific force m/s^2; forward-left-up body
    - ``odometry``: v m/s, omega rad/s; as commanded, valid until the next sample
    - ``landmark_bearings``: landmark (index), range m, bearing rad (counter-clockwise)
    - ``uav_bearings``: robot (index), range m, bearing rad
    - ``uav_ranges``: own_tag, robot, tag (indices), range m; each exchange in both ends' tables
    - ``anchor_ranges``: own_tag, anchor (indices), range m
    - ``height``: height m above the world's origin
    - ``magnetometer``: x, y, z tesla, body frame

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
        source: citation and licence.
        origin: [d] metres: where the origin of all that stands here is in the world frame that was
            recorded.
        dropped: stream name to how many of its measurements were left out, since the sensor cannot
            have given them: not finite, not positive, or beyond its reach.

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

    def __post_init__(self) -> None:
        robots = len(self.robots)
        for what, tables in {"truth": self.truth, **self.streams}.items():
            if len(tables) != robots:
                raise ValueError(f"Recording.{what} holds {len(tables)} robots, not {robots}")
        if any(track.position.shape[1] != self.dim for track in self.truth):
            raise ValueError(f"Recording.truth is not in {self.dim} dimensions")
        for what, array in {"landmarks": self.landmarks, "anchors": self.anchors}.items():
            if array.ndim != 2 or array.shape[1] != self.dim:
                raise ValueError(f"Recording.{what} has shape {array.shape}, not [n, {self.dim}]")
            check_places(f"Recording.{what}", array)
        if self.tags.ndim != 3 or self.tags.shape[::2] != (robots, self.dim):
            raise ValueError(f"Recording.tags has shape {self.tags.shape}, not [{robots}, K, d]")


def plausible(distance: Floats, most: float) -> Flags:
    """Which distances a sensor that reaches ``most`` m can have measured."""
    return np.isfinite(distance) & (distance > 0) & (distance <= most)


def near_origin(recording: Recording) -> Recording:
    """The recording about an origin of its own, the middle of its truth to the kilometre, so that
    float32 has digits enough; unchanged where that is within half a kilometre of the origin."""
    places = np.concatenate([track.position for track in recording.truth])
    middle = 0.5 * (places.min(0) + places.max(0))
    origin = 1000.0 * np.round(middle / 1000.0)
    if not origin.any():
        return recording
    streams = dict(recording.streams)
    if recording.dim == 3 and "height" in streams:
        streams["height"] = tuple(
            replace(table, values=table.values - origin[2]) for table in streams["height"]
        )
    return replace(
        recording,
        truth=tuple(replace(track, position=track.position - origin) for track in recording.truth),
        streams=streams,
        landmarks=recording.landmarks - origin,
        anchors=recording.anchors - origin,
        origin=tuple(origin.tolist()),
    )


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
    if np.any(np.diff(time) < int(strictly)):
        raise ValueError("time does not increase")
