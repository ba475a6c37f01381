"""TU Chemnitz "Labyrinth": one wheeled robot among four ultra-wideband anchors, in the plane."""

import os
from pathlib import Path

import numpy as np

from coloc_env.datasets.files import FileFormat, Rows, distinct, fail, read
from coloc_env.datasets.folders import entries
from coloc_env.datasets.recording import Floats, Recording, Stamps, Table, Track, plausible

SOURCE = "The Labyrinth Dataset; Pfeifer (TU Chemnitz), in libRSF, 2017-2023; CC BY-SA 4.0"
_RANGES = FileFormat(
    ("range", "variance", "x", "y", "anchor", "snr"),
    "relative seconds",
    whole=("anchor",),
    words=("range2", "odom2diff"),
    optional=("range",),
)
_ODOMETRY = FileFormat(
    ("wheel_1", "wheel_2", "sideways", "base", "variance_1", "variance_2", "variance_sideways"),
    "relative seconds",
    words=("odom2diff", "range2"),
)
_TRUTH = FileFormat(("x", "y", "xx", "xy", "yx", "yy"), "relative seconds", words=("point2",))
_REACH = 300.0  # m, of ultra-wideband ranging
_MOVING = 0.1  # m/s: the truth is given to 4 mm, each 0.13 s


def load_tuc(stem: str | os.PathLike[str]) -> Recording:
    """Load one sequence: ``STEM_Input.txt`` and ``STEM_GT.txt``.

    Time zero is the recording's own. Anchors are in the order of their numbers. There is one range
    at each stamp, from one anchor after the other, with a sample of truth and of odometry. The
    truth has no heading: in its place is the course of travel, interpolated where the robot stands
    (so turns on the spot and backward travel are not in it). Streams: anchor_ranges, odometry.

    Wheel speeds become v, their mean, and omega, the second less the first over twice ``base``:
    unlike in the readme, the first column is the left wheel's and ``base`` half the distance
    between the wheels; so the odometry alone follows the truth's 9.2 m within 0.04 m RMS (start
    fitted, and speed and turn scaled by 0.99 and 1.015).

    Measured on Indoor_UWB, 29.8 s: ranges are +0.10 m too long (median; deviation 0.11 m, robust
    0.09, largest error 0.66), of the anchors +0.15, +0.07, +0.11 and +0.08 m; 4.7 % are off by
    more than 0.3 m, all too long, over half of those to anchor 107. Ranges and truth are in time
    (best lag 0.03 s), odometry and truth too (-0.03 s). Stamps are 0.128 s apart, with gaps of
    0.047 s more at 23 s and 0.032 s more at 25 s.

    Ranges that are none (not finite, not positive, beyond 300 m) are left out.

    Raises:
        DataError: a file is missing or damaged, or an anchor has two places.
    """
    stem = Path(stem)
    source = stem.with_name(f"{stem.name}_Input.txt")
    ranges, wheels = read(source, _RANGES), read(source, _ODOMETRY)
    numbers, first, index = np.unique(ranges.values[:, 4], return_index=True, return_inverse=True)
    anchors = ranges.values[first, 2:4]
    if (moved := (ranges.values[:, 2:4] != anchors[index]).any(axis=1)).any():
        fail(source, _RANGES, moved, f"anchor {numbers[index][moved][0]:g} is in another place")
    if (bad := wheels.values[:, 3] <= 0).any():
        fail(source, _ODOMETRY, bad, "the distance between the wheels is not positive")
    heard = np.column_stack((np.zeros(len(index)), index.astype(np.float64), ranges.values[:, 0]))
    there = plausible(heard[:, 2], _REACH)
    return Recording(
        name=f"tuc/{stem.name}",
        dim=2,
        robots=("robot",),
        truth=(_track(read(stem.with_name(f"{stem.name}_GT.txt"), _TRUTH)),),
        streams={
            "anchor_ranges": (
                Table(ranges.time[there], heard[there], ("own_tag", "anchor", "range")),
            ),
            "odometry": (_odometry(wheels),),
        },
        landmarks=np.empty((0, 2)),
        anchors=anchors,
        tags=np.zeros((1, 1, 2)),
        source=SOURCE,
        dropped={"anchor_ranges": int((~there).sum())},
    )


def sequences_in(folder: Path) -> dict[str, int]:
    """What the names of a sequence's two files have in common, and its one robot."""
    truths = [path.name.removesuffix("_GT.txt") for path in entries(folder, "*_GT.txt")]
    return {name: 1 for name in truths if (folder / f"{name}_Input.txt").is_file()}


def _odometry(wheels: Rows) -> Table:
    left, right, _, base = wheels.values[:, :4].T
    values = np.column_stack((0.5 * (left + right), 0.5 * (right - left) / base))
    return Table(wheels.time, values, ("v", "omega"))


def _track(rows: Rows) -> Track:
    time, values = distinct(rows)
    return Track(time, values[:, :2], _course(time, values[:, :2])[:, None])


def _course(time: Stamps, position: Floats) -> Floats:
    """Direction of travel [T], rad; zero if it never moves."""
    if len(time) < 2:
        return np.zeros(len(time))
    velocity = np.gradient(position, 1e-9 * time, axis=0)
    moving = np.hypot(*velocity.T) > _MOVING
    if not moving.any():
        return np.zeros(len(time))
    heading = np.unwrap(np.arctan2(velocity[moving, 1], velocity[moving, 0]))
    return np.interp(time, time[moving], heading)
