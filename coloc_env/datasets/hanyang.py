"""Hanyang University outdoors: a tag carried about anchors on a platform, with RTK-GNSS truth."""

import os
from pathlib import Path

import numpy as np

from coloc_env.datasets.files import FileFormat, distinct, fail, read
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
    "Comprehensive outdoor UWB dataset (Hanyang University); doi 10.5281/zenodo.15226105; "
    "Apache-2.0"
)
_RANGES = FileFormat(
    ("field.id", "field.x", "field.y", "field.z", "field.distanceFromTag"),
    "nanoseconds",
    ",",
    header=True,
    whole=("field.id",),
    stamp_column="field.stamp",
    optional=("field.distanceFromTag",),
)
_TRUTH = FileFormat(("x", "y", "heading_degrees"), "nanoseconds", ",", header=True)
_TAG_HEIGHT = 1.1  # m above the ground
_REACH = 300.0  # m, of ultra-wideband ranging


def load_hanyang(folder: str | os.PathLike[str]) -> Recording:
    """Load one case: ``trajectory.csv`` and a file ``A<number>.csv`` for each anchor.

    The recording is in the plane. The tag moves on flat ground (by the truth it leaves its height
    by less than 0.5 m), and anchors that are 0.5 to 2 m high and within 5 m of each other show a
    tag 10 to 50 m away nothing of its height. So each range r is made horizontal, sqrt(r^2 - h^2)
    with h the height between anchor and tag; the few ranges shorter than h (3 of 9447 in
    NLOS/Trajectory_A) are dropped, and those that are no range (not finite, not positive, beyond
    300 m). The tag's height is not recorded: 1.1 m (fitted: 1.07 to
    1.13 m in the four cases).

    Time zero is the first truth, and stamps are as recorded. Anchors are in the order of their
    numbers. The attitude is the recorded heading, a course made from the positions. Stream:
    anchor_ranges.

    Measured on the four cases at hand (LOS A, LOS B, NLOS A, NLOS B), range minus truth:

    - ranges are late: they fit best the truth of 0.184, 0.178, 0.165 and 0.183 s before their
      stamps. GNSS fixes arrive 0.03 to 0.09 s after theirs, so the clocks agree better than that
    - with 0.18 s taken off, +0.06, +0.03, +0.13 and +0.08 m (median), the anchors of a case within
      0.06 m of each other; robust deviation 0.10, 0.11, 0.08 and 0.12 m, without that 0.17, 0.22,
      0.14 and 0.23. It grows with the distance: -0.09 to +0.05 m within 5 m, +0.12 to +0.16 m
      beyond 20 m
    - off by more than 1 m: 0.4, 0.3, 0.5 and 0.5 %, all of them too short, by up to 19 m; longer
      than the median by 0.3 m and more: 0, 0.4, 0 and 2.2 %, at most 0.9 m. So much is left of
      the NLOS
    - ten times a second four ranges within 4 ms, up to 33 ms late; 5 to 18 % of an anchor's are
      missing, with gaps of up to 1.5 s. In NLOS A they end 55 s before the truth does
    - the truth has 8 Hz. Its stated horizontal deviation is 0.014 m, but 0.05, 0.1 and 0.16 m
      where RTK had no fix (25, 32 and 69 % of LOS B, NLOS A and NLOS B; 2.4 m in 1 s of NLOS A)

    Raises:
        DataError: a file is missing or damaged, an anchor moves or is in another's file.
    """
    folder = Path(folder)
    truth = distinct(read(folder / "trajectory.csv", _TRUTH))
    files = _anchors_in(folder)
    if not files:
        raise DataError(f"{folder}: no A<number>.csv")
    anchors, times, rows, dropped = [], [], [], 0
    for index, (number, path) in enumerate(sorted(files.items())):
        place, time, distance, without = _anchor(path, number)
        anchors.append(place)
        dropped += without
        times.append(time - truth.time[0])
        rows.append(np.column_stack((np.zeros(len(time)), np.full(len(time), index), distance)))
    time = np.concatenate(times)
    order = np.argsort(time, kind="stable")
    ranges = Table(time[order], np.concatenate(rows)[order], ("own_tag", "anchor", "range"))
    heading = np.unwrap(np.deg2rad(truth.values[:, 2:]), axis=0)
    return Recording(
        name="hanyang/" + "/".join(folder.parts[-3:]),
        dim=2,
        robots=("tag",),
        truth=(Track(truth.time - truth.time[0], truth.values[:, :2], heading),),
        streams={"anchor_ranges": (ranges,)},
        landmarks=np.empty((0, 2)),
        anchors=np.stack(anchors),
        tags=np.zeros((1, 1, 2)),
        source=SOURCE,
        dropped={"anchor_ranges": dropped},
    )


def sequences_in(folder: Path) -> dict[str, int]:
    """The cases, such as ``LOS/Trajectory_A/Case_1``, and their one tag."""
    cases = [path.parent for path in entries(folder, "*/*/*/trajectory.csv")]
    return {case.relative_to(folder).as_posix(): 1 for case in cases}


def _anchors_in(folder: Path) -> dict[int, Path]:
    """The anchors' files by their numbers."""
    files: dict[int, Path] = {}
    for path in entries(folder, "A*.csv"):
        number = path.stem.removeprefix("A")
        if number.isdecimal():
            other = files.setdefault(int(number), path)
            if other != path:
                raise DataError(f"{path}: the anchor of {other.name} again")
    return files


def _anchor(path: Path, number: int) -> tuple[Floats, Stamps, Floats, int]:
    """Its place [2], time [T] and horizontal distance [T] of its ranges, and how many were left
    out."""
    time, values = read(path, _RANGES)
    if (strange := values[:, 0] != number).any():
        fail(path, _RANGES, strange, f"field.id is {values[strange][0, 0]:g}, not {number}")
    place, distance = values[0, 1:4], values[:, 4]
    if (moved := (values[:, 1:4] != place).any(axis=1)).any():
        fail(path, _RANGES, moved, "the anchor is in another place than before")
    good = plausible(distance, _REACH)
    squared = distance**2 - (place[2] - _TAG_HEIGHT) ** 2
    there = good & (squared >= 0)
    return place[:2], time[there], np.sqrt(squared[there]), int((~good).sum())
