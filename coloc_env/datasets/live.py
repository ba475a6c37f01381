"""Measurements that come in one by one, checked and corrected as those of the open format are."""

import math
import warnings
from bisect import bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from coloc_env.datasets.corrections import corrected, stream_corrections
from coloc_env.datasets.grid import LINKS, Usual
from coloc_env.datasets.noise_model import NoiseModel
from coloc_env.datasets.open_format import streams
from coloc_env.datasets.open_format.columns import Columns, check_numbers
from coloc_env.datasets.open_format.description import Description
from coloc_env.datasets.open_format.reader import described
from coloc_env.datasets.open_format.senses import BEAMS
from coloc_env.datasets.open_format.stamps import DIGITS, nanoseconds
from coloc_env.datasets.recording import (
    IMU_COLUMNS,
    DataError,
    Floats,
    Recording,
    Stamps,
    Table,
    near_origin,
)
from coloc_env.options import unknown

_COLUMNS = {
    "imu": IMU_COLUMNS,
    "odometry": ("vx", "vy", "omega"),
    "landmark_bearings": ("landmark", "range", "bearing"),
    "uav_bearings": ("robot", "range", "bearing"),
    "landmark_vectors": ("landmark", "x", "y", "z"),
    "uav_ranges": ("own_tag", "robot", "tag", "range"),
    "anchor_ranges": ("own_tag", "anchor", "range"),
    "tdoa": ("own_tag", "from", "to", "difference"),
    "arrival_angles": ("robot", "azimuth", "elevation"),
    "flow": ("vx", "vy"),
    "compass": ("heading",),
    "rssi": ("point", "strength"),
    "uav_rssi": ("robot", "strength"),
    "light": ("lamp", "intensity", "x", "y", "z"),
    "ultrasonic": BEAMS,
    "magnetometer": ("x", "y", "z"),
    "height": ("height",),
    "position_fix": ("x", "y", "z"),
}
_INTERVALS = 255  # between samples, of which the median is usual

Sample = tuple[str, int, int, Floats]
"""Stream, robot, ns, values [F]."""


def setup_recording(about: Description) -> Recording:
    """The recording that a setup describes: its map, and one sample of zeros in each stream that
    is to come.

    Raises:
        DataError: ``streams`` is missing, or names what cannot come live.
    """
    if not about.streams:
        about.file.fail(("streams",), f"is missing: a list of {', '.join(_COLUMNS)}")
    for name in about.streams:
        if name not in streams.ORDER:
            about.file.fail(("streams",), unknown("stream", name, streams.ORDER))
    found = {}
    for name in (each for each in streams.ORDER if each in about.streams and each in _COLUMNS):
        columns = _COLUMNS[name]
        if columns[-1] == "z" and about.dim == 2:
            columns = columns[:-1]
        zeros = Table(np.zeros(1, np.int64), np.zeros((1, len(columns))), columns)
        found[name] = (zeros,) * len(about.robots)
    return near_origin(described(about, found))


class LiveSamples:
    """The last samples of each robot's streams, in the order of their stamps.

    ``recording`` (see ``setup_recording``) and ``model`` say what is to come and what is taken off;
    of its streams those in ``used`` are kept. ``driver``: the one that drives the motion model.
    """

    def __init__(
        self,
        about: Description,
        recording: Recording,
        model: NoiseModel,
        used: Sequence[str],
        driver: str,
    ) -> None:
        self.about, self.driver = about, driver
        recording = replace(recording, streams={name: recording.streams[name] for name in used})
        self.recording = corrected(recording, model)
        self._correct = stream_corrections(recording, model)
        self._origin = np.array(recording.origin or (0.0,) * about.dim) - np.array(
            about.origin or (0.0,) * about.dim
        )
        count = range(len(about.robots))
        self.times: dict[str, list[list[int]]] = {s: [[] for _ in count] for s in self.streams}
        self.rows: dict[str, list[list[Floats]]] = {s: [[] for _ in count] for s in self.streams}
        self.surplus = 0
        self._likes = [_Like() for _ in count]

    @property
    def streams(self) -> tuple[str, ...]:
        """Streams that are to come."""
        return tuple(self.recording.streams)

    @property
    def shift(self) -> Floats:
        """What is to be added to positions, m [d], to have them as the setup has them."""
        return self._origin

    @cached_property
    def _robots(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.about.robots)}

    # ---------------------------------------------------------------- in

    def read(
        self, robot: str, sensor: str, stamp: Any, values: Mapping[str, Any], line: int = 0
    ) -> list[Sample]:
        """An event as samples in our frames and units, corrected; none of a stream that is not
        used, or where the sensor cannot have measured that.

        ``sensor``: a table of the open format (``ranges``, ``imu``, …), ``values`` its columns
        (whom or what a sighting or a relative pose is of: ``to``), ``stamp`` in the setup's unit.

        Raises:
            DataError: no such robot, sensor or column, a value that is no such thing, or a stream
                that the setup does not name; ``line`` is named.
        """
        where = f"event {line}" if line else "event"
        if robot not in self._robots:
            raise DataError(f"{where}: {unknown('robot', str(robot), self.about.robots)}")
        if sensor not in streams.FILES:
            raise DataError(f"{where}: {unknown('sensor', str(sensor), streams.FILES)}")
        file, path = streams.FILES[sensor], _path(robot, sensor)
        try:
            found = Columns(path, self.time(stamp, f"{path}"), {}, {}, (), [1])
            for name, value in values.items():
                if name == "to" and "robot" in file.columns:
                    name = "robot" if value in self._robots else "landmark"
                if name not in file.columns:
                    _warn_unused(sensor, name)
                elif file.columns[name] == "name":
                    found.names[name] = ["" if value is None else str(value)]
                else:
                    found.numbers[name] = np.array([_number(value, f"{path}, column {name}")])
            check_numbers(found, file.columns)
            made = file.make(found, self.about)
        except DataError as error:
            text = str(error).replace(f"{path}, line 1", f"{path}")
            columns = ", ".join(dict.fromkeys(("stamp", *map(_as_event, file.columns))))
            raise DataError(f"{where}: {text} (columns: {columns})") from None
        samples = []
        for stream, (table, _) in made.items():
            if stream not in self.about.streams:
                named = ", ".join(self.about.streams)
                raise DataError(f"{where}: {stream} is not among the setup's streams: {named}")
            if stream not in self.streams:
                continue
            owner = self._robots[robot]
            samples += self._corrected(stream, owner, table)
            if stream == "uav_ranges" and self.about.once and len(table.time):
                back = replace(table, values=streams.seen_back(table.values, owner))
                samples += self._corrected(stream, int(table.values[0, 1]), back)
        return samples

    def insert(self, sample: Sample) -> bool:
        """Put a sample where its time says; False where the very same one is there already."""
        stream, robot, time, values = sample
        times, rows = self.times[stream][robot], self.rows[stream][robot]
        at = bisect_right(times, time)
        before = at - 1
        while before >= 0 and times[before] == time:
            if np.array_equal(rows[before], values):
                return False
            before -= 1
        times.insert(at, time)
        rows.insert(at, values)
        if stream == self.driver:
            self._likes[robot].add(time, values)
        return True

    def forget(self, before: int) -> None:
        """Drop samples before a time, but for the last of each stream."""
        for stream, team in self.times.items():
            for times, rows in zip(team, self.rows[stream], strict=True):
                old = min(bisect_right(times, before), len(times)) - 1
                if old > 0:
                    del times[:old], rows[:old]

    def stamp(self, time: int) -> int | float:
        """A time in ns as a stamp in the setup's unit."""
        digits = DIGITS[self.about.unit]
        return time if digits == 0 else time / 10**digits

    def clear(self) -> None:
        """Drop all samples."""
        for stream in self.times:
            self.times[stream] = [[] for _ in self.about.robots]
            self.rows[stream] = [[] for _ in self.about.robots]

    def state(self) -> dict[str, list[dict[str, Any]]]:
        """All samples, as ``restore`` takes them: by stream and robot, ``times`` (ns) and ``rows``
        [n, F]."""
        return {
            stream: [
                {"times": times, "rows": torch.from_numpy(np.array(rows))}
                for times, rows in zip(team, self.rows[stream], strict=True)
            ]
            for stream, team in self.times.items()
        }

    def restore(self, state: Mapping[str, Sequence[Mapping[str, Any]]]) -> int | None:
        """Hold the samples of a ``state``, and no others; the newest stamp, ns."""
        self.clear()
        for stream, team in state.items():
            for robot, found in enumerate(team):
                for time, row in zip(found["times"], found["rows"].numpy(), strict=True):
                    self.insert((stream, robot, time, row))
        every = [times[-1] for team in self.times.values() for times in team if times]
        return max(every, default=None)

    # ---------------------------------------------------------------- out

    def first(self) -> int | None:
        """When every robot has a sample of the driver (without one: when any sample is there)."""
        if self.driver:
            team = self.times[self.driver]
            return max(times[0] for times in team) if all(team) else None
        every = [times[0] for team in self.times.values() for times in team if times]
        return min(every, default=None)

    def window(self, after: int, until: int) -> Recording:
        """What came in (after, until]; of the driver the sample before, too, and one more behind,
        so that the last one stands as long as it may."""
        found = {}
        for stream, team in self.times.items():
            columns, tables = self.recording.streams[stream][0].columns, []
            for robot, times in enumerate(team):
                first, last = bisect_right(times, after), bisect_right(times, until)
                rows = self.rows[stream][robot]
                if stream == self.driver:
                    first = max(first - 1, 0)
                    time, values = times[first:last] or [after], rows[first:last] or rows[:1]
                    time, values = [*time, until + 1], [*values, values[-1]]
                else:
                    time, values = times[first:last], rows[first:last]
                    if stream in LINKS:
                        time, values = self._once(stream, time, values)
                array = np.array(values) if values else np.empty((0, len(columns)))
                tables.append(Table(np.array(time, np.int64), array, columns))
            found[stream] = tuple(tables)
        return replace(self.recording, streams=found)

    def like(self) -> list[Usual]:
        """What the samples of each robot's driver are like, so far."""
        return [own.usual() for own in self._likes]

    # ---------------------------------------------------------------- parts

    def _corrected(self, stream: str, robot: int, table: Table) -> list[Sample]:
        if stream in self._correct:
            table = self._correct[stream][robot](table)
        values = table.values
        if stream == "odometry" and values.shape[1] == 2:
            values = np.column_stack((values[:, 0], np.zeros(len(values)), values[:, 1]))
        elif stream == "position_fix":
            values = values - self._origin
        elif stream == "height":
            values = values - self._origin[2]
        return [(stream, robot, int(t), row) for t, row in zip(table.time, values, strict=True)]

    def _once(
        self, stream: str, time: Sequence[int], values: Sequence[Floats]
    ) -> tuple[list[int], list[Floats]]:
        """The newest measurement of each link in a step."""
        newest = {
            tuple(row[: LINKS[stream]]): (t, row) for t, row in zip(time, values, strict=True)
        }
        self.surplus += len(time) - len(newest)
        kept = sorted(newest.values(), key=lambda pair: pair[0])
        return [t for t, _ in kept], [row for _, row in kept]

    def time(self, stamp: Any, where: str) -> Stamps:
        """A stamp in the setup's unit as ns [1]; DataError, at ``where``, for what is no time."""
        if isinstance(stamp, bool) or not isinstance(stamp, int | float | str):
            raise DataError(f"{where}: stamp {stamp!r} is not a time in {self.about.unit}")
        try:
            return nanoseconds([stamp if isinstance(stamp, str) else repr(stamp)], self.about.unit)
        except ValueError:
            raise DataError(
                f"{where}: stamp {stamp!r} is not a time in {self.about.unit}"
            ) from None


class _Like:
    """What the samples of a stream are like so far (Welford 1962)."""

    def __init__(self) -> None:
        self.count, self.last = 0, 0
        self.mean: Floats = np.zeros(0)
        self.squares: Floats = np.zeros(0)
        self.intervals: deque[int] = deque(maxlen=_INTERVALS)

    def add(self, time: int, values: Floats) -> None:
        if not self.count:
            self.mean, self.squares = np.zeros_like(values), np.zeros_like(values)
        elif time > self.last:
            self.intervals.append(time - self.last)
        self.count, self.last = self.count + 1, max(time, self.last)
        off = values - self.mean
        self.mean = self.mean + off / self.count
        self.squares = self.squares + off * (values - self.mean)

    def usual(self) -> Usual:
        interval = float(np.median(self.intervals)) * 1e-9 if self.intervals else 0.0
        return Usual(self.mean, self.squares / max(self.count, 1), interval)


def _number(value: Any, where: str) -> float:
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise DataError(f"{where}: {value!r} is not a number")
    try:
        return float(value)
    except (ValueError, OverflowError):
        raise DataError(f"{where}: {value!r} is not a number") from None


def _as_event(column: str) -> str:
    """What an event calls a column: ``robot`` is whose event it is."""
    return "to" if column in ("robot", "landmark") else column


_unused: set[tuple[str, str]] = set()


def _warn_unused(sensor: str, column: str) -> None:
    """Once for each column, however many events have it; few enough are remembered."""
    if (sensor, column) not in _unused and len(_unused) < 100:
        _unused.add((sensor, column))
        allowed = ", ".join(streams.FILES[sensor].columns)
        warnings.warn(f"{sensor}: not used: {column}; known: {allowed}", stacklevel=4)


@lru_cache(maxsize=1000)
def _path(robot: str, sensor: str) -> Path:
    return Path(robot, sensor)
