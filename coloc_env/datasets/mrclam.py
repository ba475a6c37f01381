"""UTIAS MRCLAM: ground robots that see barcodes on landmarks and on each other, in the plane."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from coloc_env.datasets.files import FileFormat, Rows, distinct, fail, read
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
    "UTIAS MRCLAM; Leung, Halpern, Barfoot, Liu, IJRR 30(8):969-974, 2011; "
    "educational use, credit the University of Toronto ASRL"
)
_BARCODES = FileFormat(("subject", "barcode"), None, whole=("subject", "barcode"))
_LANDMARKS = FileFormat(("subject", "x", "y", "x_std", "y_std"), None, whole=("subject",))
_TRUTH = FileFormat(("x", "y", "heading"), "seconds")
_ODOMETRY = FileFormat(("v", "omega"), "seconds")
_SIGHTINGS = FileFormat(
    ("barcode", "range", "bearing"), "seconds", whole=("barcode",), optional=("range", "bearing")
)
_REACH = 20.0  # m: the room is 15 m by 8 m
_PARTS = ("Groundtruth", "Odometry", "Measurement")  # files of a robot


def load_mrclam(folder: str | os.PathLike[str]) -> Recording:
    """Load one dataset: ``Barcodes.dat``, ``Landmark_Groundtruth.dat`` and three files a robot.

    Time zero is the first truth of any robot. Landmarks are in the order of their subject
    numbers. Of sightings, barcodes that belong to no subject are dropped, and exact repeats of a
    line, and what is no sighting (range not finite, not positive or beyond 20 m, bearing not within
    half a turn). A robot may have none. Streams: odometry, landmark_bearings, uav_bearings.

    Measured on dataset 6, sighting minus truth: range to landmarks biased by -0.02 to +0.07 m a
    robot, robust deviation 0.08 to 0.18 m, 0.9 to 3.1 % beyond 0.5 m; range to robots +0.02 to
    +0.06 m, 0.07 to 0.13 m, at most 0.6 %; bearing 5 to 11 mrad, biased by up to -14 mrad
    (Robot4). Sightings are in time with the truth (within 0.05 s); the commanded odometry runs
    0.2 to 0.3 s ahead of it, and the robots do 0.90 to 0.95 of what is commanded.

    Raises:
        DataError: a file is missing or damaged, barcodes are not unique, or one belongs to a robot
            of which there are no files.
    """
    folder = Path(folder)
    robots = robots_in(folder)
    if not robots:
        raise DataError(f"{folder}: no RobotN_Groundtruth.dat")
    subjects = [_number(robot) for robot in robots]
    landmark_rows = read(folder / "Landmark_Groundtruth.dat", _LANDMARKS).values
    landmark_rows = landmark_rows[np.argsort(landmark_rows[:, 0], kind="stable")]
    landmark_of, robot_of = _targets(folder, subjects, landmark_rows[:, 0])

    tracks = [read(folder / f"{robot}_Groundtruth.dat", _TRUTH) for robot in robots]
    zero = min(rows.time[0] for rows in tracks)
    odometry: list[Table] = []
    landmark_bearings: list[Table] = []
    uav_bearings: list[Table] = []
    dropped = {"landmark_bearings": 0, "uav_bearings": 0}
    for robot in robots:
        wheels = read(folder / f"{robot}_Odometry.dat", _ODOMETRY)
        odometry.append(Table(wheels.time - zero, wheels.values, _ODOMETRY.columns))
        sightings = read(folder / f"{robot}_Measurement.dat", _SIGHTINGS, empty=True)
        sightings = _without_repeats(sightings)
        time = sightings.time - zero
        for stream, tables, index, column in (
            ("landmark_bearings", landmark_bearings, landmark_of, "landmark"),
            ("uav_bearings", uav_bearings, robot_of, "robot"),
        ):
            table, without = _bearings(time, sightings.values, index, column)
            tables.append(table)
            dropped[stream] += without
    return Recording(
        name=f"mrclam/{folder.name}",
        dim=2,
        robots=robots,
        truth=tuple(_track(rows, zero) for rows in tracks),
        streams={
            "odometry": tuple(odometry),
            "landmark_bearings": tuple(landmark_bearings),
            "uav_bearings": tuple(uav_bearings),
        },
        landmarks=landmark_rows[:, 1:3],
        anchors=np.empty((0, 2)),
        tags=np.empty((len(robots), 0, 2)),
        source=SOURCE,
        dropped=dropped,
    )


def robots_in(folder: Path) -> tuple[str, ...]:
    """The robots of a dataset, in the order of their subject numbers."""
    files = entries(folder, "Robot*.dat")
    parts = [path.stem.split("_", 1) for path in files]
    names = {name for name, *rest in parts if rest and rest[0] in _PARTS}
    return tuple(sorted((name for name in names if name[5:].isdecimal()), key=_number))


def _number(robot: str) -> int:
    return int(robot.removeprefix("Robot"))


def _targets(
    folder: Path, robots: Sequence[int], landmarks: Floats
) -> tuple[dict[float, int], dict[float, int]]:
    """Barcode to landmark index, and barcode to robot index."""
    path = folder / "Barcodes.dat"
    rows = read(path, _BARCODES).values
    for column, name in enumerate(_BARCODES.columns):
        first = np.unique(rows[:, column], return_index=True)[1]
        if len(first) < len(rows):
            again = ~np.isin(np.arange(len(rows)), first)
            fail(path, _BARCODES, again, f"{name} {rows[again][0, column]:g} stands there twice")
    barcode = dict(zip(rows[:, 0], rows[:, 1], strict=True))
    missing = ~np.isin(rows[:, 0], [*robots, *landmarks])
    if missing.any():
        reason = f"subject {rows[missing][0, 0]:g} is no landmark, and has no files"
        fail(path, _BARCODES, missing, reason)
    return (
        {barcode[subject]: i for i, subject in enumerate(landmarks) if subject in barcode},
        {barcode[subject]: i for i, subject in enumerate(robots) if subject in barcode},
    )


def _track(rows: Rows, zero: np.int64) -> Track:
    time, values = distinct(rows)
    return Track(time - zero, values[:, :2], np.unwrap(values[:, 2:], axis=0))


def _without_repeats(rows: Rows) -> Rows:
    whole = np.column_stack((rows.time - rows.time[:1], rows.values))
    kept = np.sort(np.unique(whole, axis=0, return_index=True)[1])
    return Rows(rows.time[kept], rows.values[kept])


def _bearings(
    time: Stamps, sightings: Floats, index: dict[float, int], column: str
) -> tuple[Table, int]:
    """The sightings of barcodes in ``index``, the barcode replaced by its index, and how many of
    them were left out."""
    seen = np.array([index.get(barcode, -1) for barcode in sightings[:, 0]], int)
    good = plausible(sightings[:, 1], _REACH) & (np.abs(sightings[:, 2]) <= np.pi)
    there = (seen >= 0) & good
    values = np.column_stack((seen, sightings[:, 1:]))[there]
    table = Table(time[there], values, (column, "range", "bearing"))
    return table, int(((seen >= 0) & ~good).sum())
