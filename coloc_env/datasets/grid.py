"""Recordings on a scenario's steps: truth interpolated, measurements only where they arrived.

Step k is at ``start + k dt``. Nothing measured is interpolated or invented: a step delivers what
arrived in (t_{k−1}, t_k]; what drives a motion model (IMU, odometry) is integrated over that
interval exactly, each sample held until the next, but no longer than it may stand for (an IMU's for
0.1 s): beyond that the stream's mean does, and how wrong that may be is given with it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_env.datasets.recording import DataError, Flags, Floats, Recording, Stamps, Table, Track

_TRUTH_WITHIN = 50_000_000  # ns: a step is scored if truth was sampled this close to it,
_TRUTH_HOLE = 1_000_000_000  # ns: and in an interval longer than this,
_TRUTH_BESIDE = 10_000_000  # ns: this close
_LEAST_DT = 0.001  # s
_PHASES = 32  # of a step, tried
LINKS = {  # how many columns name one
    "uav_ranges": 3,
    "anchor_ranges": 2,
    **dict.fromkeys(("landmark_vectors", "rssi", "uav_rssi", "light"), 1),
}
_LASTING = 1.0  # s, for which an acceleration or a rate that was not measured lasts


@dataclass(frozen=True)
class Grid:
    """T step times, int64 ns on the recording's clock, ``dt`` s apart."""

    start: int
    dt: float
    count: int

    @property
    def times(self) -> Stamps:
        return self.start + np.round(np.arange(self.count) * self.dt * 1e9).astype(np.int64)

    def step_of(self, time: Stamps) -> NDArray[np.int64]:
        """The step that delivers a measurement of each time; −1 or T for times outside."""
        step = np.searchsorted(self.times, time, side="left")
        return np.where(time <= self.start - round(self.dt * 1e9), -1, step)


def common_grid(recording: Recording, dt: float, drivers: tuple[str, ...]) -> Grid:
    """Steps over the longest span in which all robots that have truth have it, and every driving
    stream; without any of either, from the first sample of a stream to the last."""
    spans = [(t.time[0], t.time[-1]) for t in recording.truth if len(t.time)]
    for name in drivers:
        tables = recording.streams.get(name, ())
        if not tables or not all(len(table.time) for table in tables):
            raise DataError(f"{recording.name} has no {name} stream, which this scenario needs")
        spans += [(table.time[0], table.time[-1]) for table in tables]
    if not _LEAST_DT <= dt < np.inf:
        raise ValueError(f"dt={dt} is not allowed: a time in s from {_LEAST_DT}")
    if not spans:
        every = [t.time for team in recording.streams.values() for t in team if len(t.time)]
        if not every:
            raise DataError(f"{recording.name} has neither truth nor measurements")
        spans = [(min(time[0] for time in every), max(time[-1] for time in every))]
    start, end = max(s for s, _ in spans), min(e for _, e in spans)
    count = int((end - start) // round(dt * 1e9)) + 1
    if count < 2:
        raise DataError(f"{recording.name}: its streams overlap for less than one step of {dt} s")
    return Grid(int(start), dt, count)


def aligned(grid: Grid, recording: Recording, streams: tuple[str, ...]) -> Grid:
    """The grid shifted by less than a step: so that no step delivers a pair's range twice, if that
    can be, and then so that what some streams measure is as fresh as can be when it is delivered.
    """
    tables = [table for name in streams for table in recording.streams[name] if len(table.time)]
    if not tables or grid.count < 3:
        return grid
    period = round(grid.dt * 1e9)
    time = np.concatenate([table.time for table in tables])
    pairs = [_links(recording, name) for name in streams if name in LINKS]
    best, least = 0, (len(time), np.inf)
    for offset in (i * period // _PHASES for i in range(_PHASES)):
        late = time - grid.start - offset
        age = float((-late % period).mean())
        twice = sum(_repeats(_delivered(grid, offset, each), link) for each, link in pairs)
        if (twice, age) < least:
            best, least = offset, (twice, age)
    return Grid(grid.start + best, grid.dt, grid.count - (best > 0))


def _delivered(grid: Grid, offset: int, time: Stamps) -> NDArray[np.int64]:
    """The steps that deliver measurements of some times on the grid shifted by ``offset`` ns."""
    return -((grid.start + offset - time) // round(grid.dt * 1e9))


def _links(recording: Recording, stream: str) -> tuple[Stamps, NDArray[np.int64]]:
    """Times and links of all measurements of a stream: two of one link must not share a step."""
    tables = recording.streams[stream]
    ends = [table.values[:, : LINKS[stream]].astype(np.int64) for table in tables]
    owner = np.repeat(np.arange(len(tables)), [len(each) for each in ends])
    whole = np.column_stack((owner, np.concatenate(ends)))
    link = np.unique(whole, axis=0, return_inverse=True)[1].reshape(-1)
    return np.concatenate([table.time for table in tables]), link


def _repeats(step: NDArray[np.int64], link: NDArray[np.int64]) -> int:
    """How many measurements share their step and link with one before."""
    key = step * (int(link.max(initial=0)) + 1) + link
    return len(key) - len(np.unique(key))


def truth_on(grid: Grid, track: Track) -> tuple[Floats, Floats, Floats, Flags]:
    """Position, velocity, attitude [T, …] at the steps, and where truth was close enough: within
    50 ms, or 10 ms at the ends of a hole of more than 1 s."""
    times = grid.times
    position = _interpolate(times, track.time, track.position)
    attitude = _interpolate(times, track.time, track.attitude)
    if attitude.shape[1] == 4:
        attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    else:
        attitude = (attitude + np.pi) % (2 * np.pi) - np.pi
    if track.velocity is not None:
        velocity = _interpolate(times, track.time, track.velocity)
    else:
        half = round(grid.dt * 0.5e9)
        ahead, behind = (
            _interpolate(times + by, track.time, track.position) for by in (half, -half)
        )
        velocity = (ahead - behind) / grid.dt
    after = np.searchsorted(track.time, times).clip(0, len(track.time) - 1)
    later, earlier = track.time[after], track.time[(after - 1).clip(0)]
    apart = np.minimum(abs(later - times), abs(times - earlier))
    near = np.where(later - earlier > _TRUTH_HOLE, _TRUTH_BESIDE, _TRUTH_WITHIN)
    return position, velocity, attitude, apart <= near


def held_intervals(grid: Grid, table: Table) -> tuple[Floats, Floats]:
    """A stream over each step: samples [T, S, F] and for how long each holds [T, S] (s).

    Sample i holds from its time to the next one's; step k covers (t_{k−1}, t_k], step 0 nothing.
    """
    times, _ = grid.times, table.time
    cuts = np.union1d(times, table.time[(table.time > times[0]) & (table.time < times[-1])])
    length = np.diff(cuts) * 1e-9
    source = (np.searchsorted(table.time, cuts[:-1], side="right") - 1).clip(0)
    step = np.searchsorted(times, cuts[:-1], side="right")
    first = np.searchsorted(step, np.arange(grid.count))
    slot = np.arange(len(step)) - first[step]
    samples = np.zeros((grid.count, slot.max() + 1, table.values.shape[1]))
    durations = np.zeros(samples.shape[:2])
    samples[step, slot], durations[step, slot] = table.values[source], length
    return samples, durations


@dataclass(frozen=True)
class Usual:
    """What the samples of a stream are like: mean and variance [F], median interval in s."""

    mean: Floats
    variance: Floats
    interval: float


def usual(table: Table) -> Usual:
    """What all samples of a stream are like."""
    interval = float(np.median(np.diff(table.time))) * 1e-9 if len(table.time) > 1 else 0.0
    return Usual(table.values.mean(0), table.values.var(0), interval)


def bridged(table: Table, held: float, mean: Floats) -> tuple[Table, Table]:
    """Samples that stand for ``held`` s at most, and their mean from then on until the next; and 1
    where the mean stands and 0 elsewhere, in the same form."""
    most = round(held * 1e9)
    ends = np.flatnonzero(np.diff(table.time) > most)
    if not len(ends):
        return table, Table(table.time, np.zeros((len(table.time), 1)), ("missing",))
    time = np.insert(table.time, ends + 1, table.time[ends] + most)
    values = np.insert(table.values, ends + 1, mean, 0)
    missing = np.insert(np.zeros((len(table.time), 1)), ends + 1, 1.0, 0)
    return Table(time, values, table.columns), Table(time, missing, ("missing",))


def unknown_on(grid: Grid, missing: Table, spread: Floats) -> Floats:
    """Standard deviations [T, F] of what the mean over each step is off for want of samples, which
    deviate from their mean by ``spread`` [F].

    What was not measured is taken to be off by so much for about a second at a time: white noise
    that adds up to the same over a hole is √(2 · 1 s / dt) times that.
    """
    if not missing.values.any():
        return np.zeros((grid.count, len(spread)))
    samples, durations = held_intervals(grid, missing)
    share = (samples[..., 0] * durations).sum(1) / grid.dt
    return share[:, None] * spread * np.sqrt(max(1.0, 2 * _LASTING / grid.dt))


def imu_on(grid: Grid, tables: Sequence[Table], gyro_bias: Floats) -> Floats:
    """``imu`` leaf [T, N, 6] of N robots: increments of velocity and attitude over each step,
    divided by dt, in the body frame at the step's start (pre-integration; Forster et al. 2017,
    eqs. 33-36).

    ``gyro_bias`` (rad/s, [N, 3]) is taken off first, so that the rotation within a step is right.
    """
    held = [held_intervals(grid, table) for table in tables]
    width = max(durations.shape[1] for _, durations in held)
    samples, durations = (
        np.concatenate([_widened(each, width) for each in parts])
        for parts in zip(*held, strict=True)
    )  # robot by robot
    turned = (samples[..., :3] - np.repeat(gyro_bias, grid.count, 0)[:, None]) * durations[
        ..., None
    ]
    each, half = (_exp(v.reshape(-1, 3)).reshape(*v.shape[:2], 4) for v in (turned, 0.5 * turned))
    turn = np.tile((1.0, 0.0, 0.0, 0.0), (len(samples), 1))
    before = np.empty_like(each)
    for slot in range(width):
        before[:, slot] = turn
        turn = _product(turn, each[:, slot])
    middle = _product(before.reshape(-1, 4), half.reshape(-1, 4))
    pushed = _rotate(middle, samples[..., 3:].reshape(-1, 3)).reshape(*durations.shape, 3)
    gained = np.zeros((len(samples), 3))
    for slot in range(width):
        gained += pushed[:, slot] * durations[:, slot, None]
    out = np.concatenate((gained, _log(turn)), 1) / grid.dt
    out = out.reshape(len(tables), grid.count, 6).swapaxes(0, 1)
    out[0] = out[1]
    return out


def odometry_on(grid: Grid, table: Table) -> Floats:
    """``odometry`` leaf [T, 3]: displacement forward and left and turn over each step, over dt."""
    samples, durations = held_intervals(grid, table)
    moved, heading = np.zeros((grid.count, 2)), np.zeros(grid.count)
    for slot in range(samples.shape[1]):
        h = durations[:, slot]
        speed, turn = samples[:, slot, 0] * h, samples[:, slot, -1] * h
        middle = heading + 0.5 * turn
        chord = speed * np.sinc(0.5 * turn / np.pi)
        moved += np.stack((np.cos(middle), np.sin(middle)), 1) * chord[:, None]
        if samples.shape[2] == 3:  # sideways, too
            chord = samples[:, slot, 1] * h * np.sinc(0.5 * turn / np.pi)
            moved += np.stack((-np.sin(middle), np.cos(middle)), 1) * chord[:, None]
        heading += turn
    return np.concatenate((moved, heading[:, None]), 1) / grid.dt


def slots_on(
    grid: Grid, table: Table, slot: NDArray[np.int64], count: int, columns: slice
) -> tuple[Floats, Flags]:
    """Measurements [T, D, count, F] by slot, D as deep as one step ever delivers the same slot,
    and which are there [T, D, count]."""
    if not len(table.time):
        shape = (grid.count, 1, count)
        return np.zeros((*shape, table.values[:, columns].shape[1])), np.zeros(shape, dtype=bool)
    step = grid.step_of(table.time)
    inside = (step >= 0) & (step < grid.count)
    step, slot, values = step[inside], slot[inside], table.values[inside, columns]
    order = np.lexsort((np.arange(len(step)), slot, step))
    step, slot, values = step[order], slot[order], values[order]
    key = step * count + slot
    depth = np.arange(len(key)) - np.searchsorted(key, key)
    shape = (grid.count, int(depth.max(initial=0)) + 1, count)
    out, there = np.zeros((*shape, values.shape[1])), np.zeros(shape, dtype=bool)
    out[step, depth, slot], there[step, depth, slot] = values, True
    return out, there


def last_on(grid: Grid, table: Table) -> tuple[Floats, Flags]:
    """The newest sample [T, F] of each step, and where one came [T]."""
    step = grid.step_of(table.time)
    inside = (step >= 0) & (step < grid.count)
    out = np.zeros((grid.count, table.values.shape[1]))
    there = np.zeros(grid.count, dtype=bool)
    out[step[inside]], there[step[inside]] = table.values[inside], True
    return out, there


def _widened(values: Floats, width: int) -> Floats:
    """[T, S, …] with S = ``width``, by zeros."""
    if values.shape[1] == width:
        return values
    return np.pad(values, ((0, 0), (0, width - values.shape[1]), *[(0, 0)] * (values.ndim - 2)))


def _interpolate(at: Stamps, time: Stamps, values: Floats) -> Floats:
    zero = time[0]
    x, xp = (at - zero) * 1e-9, (time - zero) * 1e-9
    return np.stack([np.interp(x, xp, column) for column in values.T], 1)


def _product(a: Floats, b: Floats) -> Floats:
    w = a[:, :1] * b[:, :1] - np.sum(a[:, 1:] * b[:, 1:], 1, keepdims=True)
    v = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + _cross(a[:, 1:], b[:, 1:])
    return np.concatenate((w, v), 1)


def _rotate(q: Floats, v: Floats) -> Floats:
    t = 2 * _cross(q[:, 1:], v)
    return v + q[:, :1] * t + _cross(q[:, 1:], t)


def _cross(a: Floats, b: Floats) -> Floats:
    """a × b, row by row: what ``np.cross`` gives, at a third of its price for few rows."""
    (x, y, z), (u, v, w) = a.T, b.T
    return np.stack((y * w - z * v, z * u - x * w, x * v - y * u), 1)


def _exp(v: Floats) -> Floats:
    angle = np.linalg.norm(v, axis=1, keepdims=True)
    return np.concatenate((np.cos(angle / 2), 0.5 * np.sinc(angle / 2 / np.pi) * v), 1)


def _log(q: Floats) -> Floats:
    sine = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[:, :1])
    return np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0) * q[:, 1:]
