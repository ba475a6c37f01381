"""What sensors said less what the truth says: residuals of a recording's measurements.

Truth is interpolated between its samples, and only where they are at most 0.25 s apart.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_env.datasets.recording import Flags, Floats, Recording, Stamps, Table, Track

_HOLE = 250_000_000  # ns between samples of truth that are bridged
_FEW, _MANY = 20, 100  # ranges of a link, and of all, of fewer of which no delay is estimated
_CHANGE = 1_000_000_000  # ns over which errors are watched change
FALLS = 0.95  # of a deviation: what a delay must make of it
_OWN = 0.8  # of the deviation with the others' delay: what is less shows that a link has its own
_LATEST = 600_000_000  # ns, the largest delay that is looked for


@dataclass(frozen=True, eq=False)
class Link:
    """Ranges of one link, ``ROBOT/OTHER``: times [T], own and other's tag, and ranges (m)."""

    name: str
    robot: int
    other: int
    to_anchor: bool
    time: Stamps
    tags: NDArray[np.int64]
    measured: Floats


def links_of(recording: Recording, stream: str) -> list[Link]:
    """A stream of ranges, link by link."""
    to_anchor = stream == "anchor_ranges"
    names = recording.anchor_names if to_anchor else recording.robots
    found = []
    for robot, table in enumerate(recording.streams.get(stream, ())):
        ends = table.values[:, 1].astype(np.int64)
        for other in np.unique(ends):
            there = ends == other
            own = table.values[there, 0]
            theirs = np.zeros(len(own)) if to_anchor else table.values[there, 2]
            name = f"{recording.robots[robot]}/{names[other]}"
            tags = np.stack((own, theirs), 1).astype(np.int64)
            link = Link(
                name, robot, int(other), to_anchor, table.time[there], tags, table.values[there, -1]
            )
            found.append(link)
    return found


def has_truth(recording: Recording, link: Link) -> bool:
    """Whether there is truth of both ends of a link."""
    ends = [link.robot] if link.to_anchor else [link.robot, link.other]
    return all(len(recording.truth[end].time) > 1 for end in ends)


def pose_at(track: Track, time: Stamps) -> tuple[Floats, Floats, Flags]:
    """Position [T, d], attitude [T, a] and where they are known, at some times."""
    zero = track.time[0]
    x, xp = (time - zero) * 1e-9, (track.time - zero) * 1e-9
    after = np.searchsorted(track.time, time).clip(1, max(1, len(track.time) - 1))
    gap = track.time[after.clip(0, len(track.time) - 1)] - track.time[after - 1]
    known = (time >= zero) & (time <= track.time[-1]) & (gap <= _HOLE)
    position, attitude = (
        np.stack([np.interp(x, xp, column) for column in values.T], 1)
        for values in (track.position, track.attitude)
    )
    if attitude.shape[1] == 4:
        attitude = attitude / np.linalg.norm(attitude, axis=1, keepdims=True)
    return position, attitude, known


def turned(attitude: Floats, vectors: Floats) -> Floats:
    """Body vectors [T, d] in the world, by attitudes [T, a]."""
    if attitude.shape[1] == 1:
        c, s = np.cos(attitude[:, 0]), np.sin(attitude[:, 0])
        x, y = vectors.T
        return np.stack((c * x - s * y, s * x + c * y), 1)
    t = 2 * np.cross(attitude[:, 1:], vectors)
    return vectors + attitude[:, :1] * t + np.cross(attitude[:, 1:], t)


def tag_at(
    recording: Recording, robot: int, tag: NDArray[np.int64], time: Stamps
) -> tuple[Floats, Flags]:
    """World positions [T, d] of a robot's tags, and where they are known."""
    position, attitude, known = pose_at(recording.truth[robot], time)
    if recording.tags.shape[1]:
        position = position + turned(attitude, np.nan_to_num(recording.tags[robot][tag]))
    return position, known


def true_ranges(recording: Recording, link: Link, delay: float = 0.0) -> tuple[Floats, Flags]:
    """Distances [T] (m) by the truth ``delay`` s before each stamp, and where they are known."""
    time = link.time - round(delay * 1e9)
    own, known = tag_at(recording, link.robot, link.tags[:, 0], time)
    if link.to_anchor:
        other: Floats = recording.anchors[link.other]
    else:
        other, there = tag_at(recording, link.other, link.tags[:, 1], time)
        known = known & there
    return np.linalg.norm(own - other, axis=1), known


def sighting_residuals(recording: Recording, stream: str, robot: int) -> tuple[Floats, Flags]:
    """Range (m) and bearing (rad) [T, 2] less the truth's, and where that is known."""
    table: Table = recording.streams[stream][robot]
    position, heading, known = pose_at(recording.truth[robot], table.time)
    seen = table.values[:, 0].astype(np.int64)
    if stream == "landmark_bearings":
        places = recording.landmarks[seen]
    else:
        places = np.zeros_like(position)
        for other in np.unique(seen):
            there = seen == other
            places[there], _, near = pose_at(recording.truth[other], table.time[there])
            known[there] &= near
    apart = places - position
    angle = np.arctan2(apart[:, 1], apart[:, 0]) - heading[:, 0]
    off = np.stack((np.linalg.norm(apart, axis=1), angle), 1)
    residual = table.values[:, 1:3] - off
    residual[:, 1] = (residual[:, 1] + np.pi) % (2 * np.pi) - np.pi
    return residual, known


def robust(values: Floats) -> tuple[float, float]:
    """Median, and the standard deviation that the median absolute deviation stands for."""
    if not len(values):
        return float("nan"), float("nan")
    middle = float(np.median(values))
    return middle, float(1.4826 * np.median(np.abs(values - middle)))


def best_delay(recording: Recording, links: Sequence[Link]) -> float:
    """The delay (s) with which ranges of some links fit the truth best: the least robust deviation,
    all links' together; 0 where the motion shows nothing of it (it must fall by a twentieth).

    Biases that last, or grow with the distance, are not to pass for a delay. So what is looked at
    is how much errors change in a second or, where that shows nothing, errors about a line over the
    distance.
    """
    return next(filter(None, (_least(recording, links, look) for look in (changes, spread))), 0.0)


def link_delay(recording: Recording, link: Link, common: float) -> float:
    """A link's own delay (s) where it explains its ranges far better than the others' does: of so
    few ranges the best of many delays fits better by chance."""
    own, by_chance = best_delay(recording, [link]), 3 * len(link.time) ** -0.5
    if spread(recording, link, own) < min(_OWN, 1 - by_chance) * spread(recording, link, common):
        return own
    return common


def _least(
    recording: Recording, links: Sequence[Link], look: Callable[[Recording, Link, float], float]
) -> float:
    """The delay of the least deviation, or 0."""
    delays = np.arange(-_LATEST, _LATEST + 1, 20_000_000) * 1e-9
    curves = np.array([[look(recording, link, delay) for delay in delays] for link in links])
    count = np.array([len(link.time) for link in links])
    known = ~np.isnan(curves).any(1) if len(links) else np.zeros(0, bool)
    if count[known].sum() < _MANY:
        return 0.0
    whole = np.average(np.log(np.maximum(curves[known], 1e-4)), axis=0, weights=count[known])
    best = int(np.argmin(whole))
    if not 0 < best < len(delays) - 1 or whole[best] > whole[len(delays) // 2] + np.log(FALLS):
        return 0.0
    left, middle, right = whole[best - 1 : best + 2]
    bend = left - 2 * middle + right
    shift = 0.5 * (left - right) / bend if bend > 0 else 0.0
    return float(np.round(delays[best] + 0.02 * shift, 3))


def changes(recording: Recording, link: Link, delay: float) -> float:
    """The robust deviation (m) of how much the errors of a link's ranges, ``delay`` s late, change
    in a second; NaN where there are too few."""
    distance, known = true_ranges(recording, link, delay)
    time, error = link.time[known], (link.measured - distance)[known]
    later = np.searchsorted(time, time + _CHANGE)
    there = later < len(time)
    there[there] &= time[later[there]] - time[there] < 2 * _CHANGE
    if there.sum() < _FEW:
        return float("nan")
    return robust(error[later[there]] - error[there])[1]


def spread(recording: Recording, link: Link, delay: float) -> float:
    """The robust deviation (m) of a link's ranges ``delay`` s late about a line over the distance;
    NaN where there are too few."""
    distance, known = true_ranges(recording, link, delay)
    if known.sum() < _FEW:
        return float("nan")
    return robust(_detrended(distance[known], (link.measured - distance)[known]))[1]


def _detrended(distance: Floats, error: Floats) -> Floats:
    """Errors less a line over the distance, by reweighted least squares."""
    x = distance - np.median(distance)
    rest, weight = error, np.ones(len(error))
    for _ in range(4):
        centre, offset = np.average(x, weights=weight), np.average(error, weights=weight)
        power = float((weight * (x - centre) ** 2).sum())
        slope = float((weight * (x - centre) * (error - offset)).sum()) / max(power, 1e-9)
        rest = error - offset - slope * (x - centre)
        weight = 1 / np.maximum(np.abs(rest), 0.02)
    return rest
