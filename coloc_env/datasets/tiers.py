"""TIERS (Turku): four ground robots that range each other by ultra-wideband, in the plane."""

import os
import re
from pathlib import Path

import numpy as np

from coloc_env.datasets.folders import entries
from coloc_env.datasets.recording import (
    DataError,
    Floats,
    Recording,
    Stamps,
    Table,
    Track,
    plausible,
)

SOURCE = (
    "TIERS uwb-cooperative-mrs-localization; Xianjia et al., arXiv 2304.06264, 2023; MIT licence"
)
_PERIOD = 138_000_000  # ns between samples
_REACH = 300.0  # m, of ultra-wideband ranging
_POSE = re.compile(r"optitrack_(turtle(\d+))_pose_np")
_RANGE = re.compile(r"uwb_range_(\d+)_(\d+)_np")


def load_tiers(file: str | os.PathLike[str], *, held: bool = False) -> Recording:
    """Load one sequence: ``STEM.npz``, the owners' arrays of one sample per row.

    Robots are in the order of their numbers (1, 3, 4, 5; 5 stands still). Attitude is OptiTrack's
    heading, unwrapped. Stream: uav_ranges, one tag each and no lever arms. A range of 0.0 is one
    that has not yet come, and is dropped, as is what is no range (not finite, negative, beyond
    300 m).

    The file has no stamps, and its owners hold each range until the next one comes: 14 % of the
    numbers (13 to 15 % a pair) repeat the one before, up to 6 times. They are dropped unless
    ``held``; two measurements that agree to the centimetre look the same as one that is held.

    Samples are taken to be 0.138 s apart. Their times follow from ``20221011_processed.csv``,
    which samples the same drive at 7.00 Hz, with stamps (``floor(t) + 10 frac(t)``, since their
    fraction was written as nanoseconds over 1e10) and OptiTrack's distances, but no positions: row
    k + 90 of it and sample 122.7 + 1.034 k show the same six distances to 1 mm. From there to the
    end of the drive samples are 0.1383 s apart on average, 0.135 to 0.142 within 13 s. Distances
    and ranges within a sample belong together whatever its time.

    Measured on 4robots_data_01, range minus OptiTrack's distance (median, robust deviation; m):

    - 1-5 +0.19, 0.05; 3-5 +0.49, 0.09; 4-5 +0.40, 0.08; 3-4 +0.35, 0.07; 1-4 +0.30, 0.07; 1-3
      +0.37, 0.10; the largest errors are +0.33 to +1.28, too long all of them. Biases of the first
      60 s are those of the rest within 0.03 m
    - the error follows the place on the circle (the medians of 20 s change by 0.1 m for 1-3 and
      4-5), which where the tags sit on the robots may explain: that is not recorded
    - ranges fit best the truth of 0 to 3 samples before

    Raises:
        DataError: the file is missing or damaged, holds no or not all ranges between robots, or
            ranges of a robot without poses.
    """
    path = Path(file).with_suffix(".npz")
    arrays = _read(path)
    robots = _robots(path, arrays)
    if len(robots) < 2:
        raise DataError(f"{path}: no optitrack_turtle0N_pose_np of two robots or more")
    tracks, time = [], None
    for number, robot in robots.items():
        position = _finite(path, arrays, f"optitrack_{robot}_pose_np", (-1, 2))
        count = len(position)
        heading = _finite(path, arrays, f"optitrack_{robot}_orientation_np", (count,))
        if time is None:
            time = _PERIOD * np.arange(count)
        elif len(time) != count:
            raise DataError(f"{path}: robot {number} has {count} samples, not {len(time)}")
        tracks.append(Track(time, position, np.unwrap(heading)[:, None]))
    assert time is not None
    ranges, dropped = _ranges(path, arrays, list(robots), time, held)
    return Recording(
        name=f"tiers/{path.stem}",
        dim=2,
        robots=tuple(robots.values()),
        truth=tuple(tracks),
        streams={"uav_ranges": ranges},
        landmarks=np.empty((0, 2)),
        anchors=np.empty((0, 2)),
        tags=np.zeros((len(robots), 1, 2)),
        source=SOURCE,
        dropped={"uav_ranges": dropped},
    )


def sequences_in(folder: Path) -> dict[str, int]:
    """The names of the files of arrays, and their numbers of robots (0 for one that is damaged)."""
    found = {}
    for path in entries(folder, "*.npz"):
        try:
            found[path.stem] = len(_robots(path, _read(path)))
        except DataError:
            found[path.stem] = 0
    return found


def _read(path: Path) -> dict[str, Floats]:
    if not path.is_file():
        raise DataError(f"{path}: no such file")
    try:
        with np.load(path, allow_pickle=False) as archive:
            return dict(archive)
    except Exception as error:  # a damaged archive raises errors of many kinds
        raise DataError(f"{path}: cannot be read: {' '.join(str(error).split())}") from None


def _robots(path: Path, arrays: dict[str, Floats]) -> dict[int, str]:
    """The robots' names by their numbers, in order."""
    found: dict[int, str] = {}
    for match in filter(None, map(_POSE.fullmatch, arrays)):
        if found.setdefault(int(match[2]), match[1]) != match[1]:
            raise DataError(f"{path}: {match[1]} is also {found[int(match[2])]}")
    for match in filter(None, map(_RANGE.fullmatch, arrays)):
        for number in map(int, match.groups()):
            if found and number not in found:
                raise DataError(f"{path}: {match[0]}, but no pose of robot {number}")
    return dict(sorted(found.items()))


def _array(path: Path, arrays: dict[str, Floats], name: str, shape: tuple[int, ...]) -> Floats:
    """An array of decimal numbers of a shape (−1: any size but 0)."""
    if name not in arrays:
        raise DataError(f"{path}: no array {name}")
    array = arrays[name]
    fits = array.ndim == len(shape) and array.size > 0
    if not fits or any(want not in (-1, has) for want, has in zip(shape, array.shape, strict=True)):
        wanted = ", ".join("n" if size < 0 else str(size) for size in shape)
        raise DataError(f"{path}: {name} has shape {list(array.shape)}, not [{wanted}]")
    if array.dtype.kind != "f":
        raise DataError(f"{path}: {name} holds {array.dtype}, not decimal numbers")
    return array.astype(np.float64)


def _finite(path: Path, arrays: dict[str, Floats], name: str, shape: tuple[int, ...]) -> Floats:
    """An array of finite numbers."""
    array = _array(path, arrays, name, shape)
    bad = ~np.isfinite(array.reshape(len(array), -1)).all(axis=1)
    if bad.any():
        raise DataError(f"{path}: {name}, sample {bad.argmax()}: not a finite number")
    return array


def _ranges(
    path: Path, arrays: dict[str, Floats], numbers: list[int], time: Stamps, held: bool
) -> tuple[tuple[Table, ...], int]:
    """Each robot's table of ranges to the others, and how many ranges were left out."""
    dropped = 0
    rows: list[list[Floats]] = [[] for _ in numbers]  # sample, own tag, robot, tag, range
    for i, first in enumerate(numbers):
        for j, second in enumerate(numbers[:i]):
            names = [f"uwb_range_{a}_{b}_np" for a, b in ((first, second), (second, first))]
            name = names[0] if names[0] in arrays else names[1]
            distance = _array(path, arrays, name, (len(time),))
            good = plausible(distance, _REACH)
            dropped += int((~good & (distance != 0)).sum())
            fresh = np.not_equal(distance, np.concatenate(([np.nan], distance[:-1])))
            there = np.flatnonzero(good & (fresh | held))
            for own, other in ((i, j), (j, i)):
                row = np.zeros((len(there), 5))
                row[:, 0], row[:, 2], row[:, 4] = there, other, distance[there]
                rows[own].append(row)
    tables = []
    for mine in rows:
        table = np.concatenate(mine)
        table = table[np.argsort(table[:, 0], kind="stable")]
        stamps = time[table[:, 0].astype(np.int64)]
        tables.append(Table(stamps, table[:, 1:], ("own_tag", "robot", "tag", "range")))
    return tuple(tables), dropped
