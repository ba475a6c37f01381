"""MILUV: quadcopters indoors with IMU, ultra-wideband ranging, laser height and Vicon truth."""

import csv
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from coloc_env.datasets.files import FileFormat, Rows, distinct, fail, read
from coloc_env.datasets.folders import entries
from coloc_env.datasets.recording import (
    IMU_COLUMNS,
    DataError,
    Flags,
    Floats,
    Recording,
    Stamps,
    Table,
    Track,
    check_places,
    one_hemisphere,
    plausible,
)

SOURCE = (
    "MILUV (McGill DECAR); Shalaby et al., IJRR 2025, arXiv 2504.14376; configuration MIT, "
    "data as stated at doi 10.25452/figshare.plus.28386041"
)
_XYZ = ("x", "y", "z")


def _csv(*columns: str, whole: tuple[str, ...] = (), optional: tuple[str, ...] = ()) -> FileFormat:
    return FileFormat(columns, "relative seconds", ",", header=True, whole=whole, optional=optional)


_TRUTH = _csv(
    *(f"pose.position.{axis}" for axis in _XYZ), *(f"pose.orientation.{axis}" for axis in "wxyz")
)
_IMU = _csv(
    *(f"{what}.{axis}" for what in ("angular_velocity", "linear_acceleration") for axis in _XYZ)
)
_HEIGHT = _csv("range", optional=("range",))
_MAGNETOMETER = _csv(*(f"magnetic_field.{axis}" for axis in _XYZ))
_RANGES = {
    name: _csv("from_id", "to_id", column, whole=("from_id", "to_id"), optional=(column,))
    for name, column in (("calibrated", "range"), ("raw", "range_raw"))
}
_FILES = ("mocap.csv", "uwb_range.csv", "imu_px4.csv", "imu_cam.csv", "height.csv")  # of a robot
_REACH = 300.0  # m, of ultra-wideband ranging
_LASER_REACH = 100.0  # m
_JUMP = np.deg2rad(30)
_LASTING = 1_000_000_000  # ns


def load_miluv(
    folder: str | os.PathLike[str],
    config: str | os.PathLike[str] | None = None,
    *,
    imu: Literal["px4", "camera"] = "px4",
    ranges: Literal["calibrated", "raw"] = "calibrated",
) -> Recording:
    """Load one experiment: a folder with one folder of CSV files per robot.

    Time zero is the experiment's own. Anchors and tags are in the order of their numbers. An
    exchange between two robots, which both may have logged, enters each one's table once. Of the
    truth, stretches shorter than 1 s beside a jump of the attitude by more than 30 degrees are
    dropped: there Vicon mistakes one marker for another, and the position is off by up to 0.1 m
    too. Streams, where there is anything for them: uav_ranges, anchor_ranges, imu, height (the
    laser's range less the robot's floor bias) and magnetometer.

    Measured on cirObstacles_3_random_0, sensor minus truth:

    - calibrated ranges: to anchors +0.02 m, robust deviation 0.09 m, 8 % beyond 0.5 m, all too
      long; between robots -0.02 m, 0.10 m, 4 %; raw ranges are about 0.1 m longer
    - height: robust deviation 0.03 to 0.10 m, as an offset that changes with the place (up to
      0.2 m for ifo002); on the ground the laser reads 0.29 m, its minimum, 0.19 to 0.27 too high
    - IMU: px4's frame is turned against Vicon's body by about 3 degrees (rotation vectors, px4 to
      Vicon: -1.6, 2.5, 0.8; 1.1, 0.6, 3.1; 1.0, -2.3, -2.2), so that gravity appears as an
      accelerometer bias of up to 0.5 m/s^2. Over 1 s its gyro and Vicon differ by 0.011 to
      0.017 rad even when aligned, which is Vicon's error: the gyros of px4 and camera agree to
      0.004, and px4's drifts by no more than 0.1 rad in 60 s
    - ``imu="camera"``: the RealSense's IMU, turned px4 <- camera <- camera IMU as calibrated; 2.1,
      0.3 and 0.4 degrees are left against px4's gyro. Its accelerometer is 1 to 6 % short at rest
      and overwhelmed by vibration in flight (vertical bias -0.8 m/s^2): use its gyro alone

    Args:
        folder: the experiment; its name is looked up in ``experiments.csv``.
        config: MILUV's ``config`` folder, by default the one beside ``folder``.
        imu: which IMU the stream holds.
        ranges: corrected for antenna delay and received power, or as measured.

    Raises:
        DataError: a file is missing or damaged, or a tag or anchor not in the configuration.
        ValueError: ``imu`` or ``ranges`` is none of the above.
    """
    for name, value, allowed in (("imu", imu, ("px4", "camera")), ("ranges", ranges, _RANGES)):
        if value not in allowed:
            raise ValueError(f"{name} is {value!r}, not one of {', '.join(allowed)}")
    folder = Path(folder)
    settings = Path(config) if config else folder.parent / "config"
    robots = robots_in(folder)
    if not robots:
        raise DataError(f"{folder}: no robot's folder with mocap.csv")
    homes = [folder / robot for robot in robots]
    anchors = _anchors(settings, folder.name, robots)
    tags = _tags(settings, robots)

    streams, dropped = _exchanges(homes, anchors, tags, _RANGES[ranges])
    if rows := _of_all(homes, "imu_cam.csv" if imu == "camera" else "imu_px4.csv", _IMU):
        turns = [_camera_to_px4(settings, robot) if imu == "camera" else None for robot in robots]
        streams["imu"] = tuple(map(_imu, rows, turns))
    if rows := _of_all(homes, "height.csv", _HEIGHT):
        biases = _height_biases(settings, robots)
        there = [plausible(values[:, 0], _LASER_REACH) for _, values in rows]
        dropped["height"] = sum(int((~good).sum()) for good in there)
        streams["height"] = tuple(
            Table(time[good], values[good] - bias, ("height",))
            for (time, values), good, bias in zip(rows, there, biases, strict=True)
        )
    if rows := _of_all(homes, "mag.csv", _MAGNETOMETER):
        streams["magnetometer"] = tuple(Table(*each, _XYZ) for each in rows)
    return Recording(
        name=f"miluv/{folder.name}",
        dim=3,
        robots=robots,
        truth=tuple(_track(home / "mocap.csv") for home in homes),
        streams=streams,
        landmarks=np.empty((0, 3)),
        anchors=anchors.positions,
        tags=_lever_arms(tags),
        source=SOURCE,
        dropped=dropped,
    )


def robots_in(folder: Path) -> tuple[str, ...]:
    """The robots of an experiment, in the order of their names; their files may be incomplete."""
    folders = [path for path in entries(folder) if path.is_dir()]
    return tuple(path.name for path in folders if any((path / file).is_file() for file in _FILES))


def _of_all(homes: Sequence[Path], file: str, form: FileFormat) -> list[Rows]:
    """This file of every robot; nothing if no robot has it."""
    if not any((home / file).exists() for home in homes):
        return []
    return [read(home / file, form) for home in homes]


def _imu(rows: Rows, turn: Floats | None) -> Table:
    values = rows.values
    if turn is not None:
        values = np.hstack((values[:, :3] @ turn.T, values[:, 3:] @ turn.T))
    return Table(rows.time, values, IMU_COLUMNS)


def _track(path: Path) -> Track:
    rows = read(path, _TRUTH)
    length = np.linalg.norm(rows.values[:, 3:], axis=1)
    if (bad := np.abs(length - 1) > 0.01).any():
        fail(path, _TRUTH, bad, f"the quaternion has length {length[bad][0]:.3f}, not 1")
    time, values = distinct(rows)
    attitude = values[:, 3:] / np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
    sound = _steady(time, attitude)
    if not sound.any():
        raise DataError(f"{path}: the attitude jumps in every second")
    return Track(time[sound], values[sound, :3], one_hemisphere(attitude[sound]))


def _steady(time: Stamps, attitude: Floats) -> Flags:
    """Which samples [T] belong to a stretch without jumps that lasts, or that is the only one."""
    cosine = np.abs(np.sum(attitude[1:] * attitude[:-1], axis=1))
    jumps = np.flatnonzero(cosine < np.cos(_JUMP / 2))
    first, last = np.append(0, jumps + 1), np.append(jumps, len(time) - 1)
    lasting = (time[last] - time[first] >= _LASTING) | (len(jumps) == 0)
    return np.repeat(lasting, last - first + 1)


@dataclass(frozen=True)
class _Points:
    """Numbered points: anchors in the world, or the tags of a robot in its body."""

    numbers: tuple[int, ...]
    positions: Floats


def _exchanges(
    homes: Sequence[Path], anchors: _Points, tags: Sequence[_Points], form: FileFormat
) -> tuple[dict[str, tuple[Table, ...]], dict[str, int]]:
    """The tables of ranges, and how many of each were left out. An end is (robot, tag), an anchor's
    end is (-1, anchor), indices."""
    starts = {
        number: (robot, index)
        for robot, points in enumerate(tags)
        for index, number in enumerate(points.numbers)
    }
    ends = {number: (-1, index) for index, number in enumerate(anchors.numbers)} | starts
    logged, measured = [], []
    for home in homes:
        path = home / "uwb_range.csv"
        time, values = read(path, form, empty=True)
        for column, known in enumerate((starts, ends)):
            if (strange := ~np.isin(values[:, column], list(known))).any():
                number = values[strange][0, column]
                fail(path, form, strange, f"{form.columns[column]} {number:g} is not in the config")
        logged.append(np.column_stack((time, values[:, :2].astype(np.int64))))
        measured.append(values[:, 2])
    exchanges, first = np.unique(np.concatenate(logged), axis=0, return_index=True)
    time, distance = exchanges[:, 0], np.concatenate(measured)[first]
    start = np.array([starts[number] for number in exchanges[:, 1]], int).reshape(-1, 2)
    end = np.array([ends[number] for number in exchanges[:, 2]], int).reshape(-1, 2)
    good = plausible(distance, _REACH)
    dropped = {
        "uav_ranges": int((~good & (end[:, 0] >= 0)).sum()),
        "anchor_ranges": int((~good & (end[:, 0] < 0)).sum()),
    }
    time, distance, start, end = time[good], distance[good], start[good], end[good]

    to_anchor, to_uav = [], []
    for robot in range(len(homes)):
        mine = (start[:, 0] == robot) & (end[:, 0] < 0)
        values = np.column_stack((start[:, 1], end[:, 1], distance))
        to_anchor.append(Table(time[mine], values[mine], ("own_tag", "anchor", "range")))
        answered = end[:, 0] == robot
        mine = answered | ((start[:, 0] == robot) & (end[:, 0] >= 0))
        own = np.where(answered[:, None], end, start)
        other = np.where(answered[:, None], start, end)
        values = np.column_stack((own[:, 1], other, distance))
        to_uav.append(Table(time[mine], values[mine], ("own_tag", "robot", "tag", "range")))
    tables = {"uav_ranges": tuple(to_uav), "anchor_ranges": tuple(to_anchor)}
    streams = {name: team for name, team in tables.items() if any(len(each.time) for each in team)}
    return streams, dropped


def _anchors(settings: Path, experiment: str, robots: Sequence[str]) -> _Points:
    """The anchors of an experiment, which must have so many robots."""
    path = settings / "experiments.csv"
    try:
        with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
            table = {row["experiment"]: row for row in csv.DictReader(file)}
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise _config_error(path, error) from None
    if experiment not in table:
        raise DataError(f"{path}: no line for the experiment {experiment!r}")
    row = table[experiment]
    if row.get("num_robots") not in (None, str(len(robots))):
        found = ", ".join(robots)
        raise DataError(f"{path}: {experiment} has {row['num_robots']} robots, found are {found}")
    if row.get("anchor_constellation") is None:
        raise _config_error(path, KeyError("anchor_constellation"))
    return _points(settings / "uwb" / "anchors.yaml", row["anchor_constellation"])


def _tags(settings: Path, robots: Sequence[str]) -> list[_Points]:
    return [_points(settings / "uwb" / "tags.yaml", robot) for robot in robots]


def _lever_arms(tags: Sequence[_Points]) -> Floats:
    """[N, K, 3], padded with NaN."""
    arms = np.full((len(tags), max(len(points.numbers) for points in tags), 3), np.nan)
    for robot, points in enumerate(tags):
        arms[robot, : len(points.numbers)] = points.positions
    return arms


def _points(path: Path, key: str) -> _Points:
    """The points under ``key``: numbers to vectors, which stand there as text."""
    entries: Mapping[str, str] = _entry(path, key)
    try:
        points = sorted((int(number), yaml.safe_load(text)) for number, text in entries.items())
        positions = np.array([position for _, position in points], float)
    except (AttributeError, TypeError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise _config_error(path, error) from None
    if positions.shape != (len(points), 3):
        raise DataError(f"{path}: {key!r} does not hold vectors of three numbers")
    check_places(f"{path}: {key}", positions)
    return _Points(tuple(number for number, _ in points), positions)


def _height_biases(settings: Path, robots: Sequence[str]) -> list[float]:
    path = settings / "height" / "bias.yaml"
    try:
        biases = [float(_entry(path, robot)) for robot in robots]
    except (TypeError, ValueError) as error:
        raise _config_error(path, error) from None
    if not all(abs(bias) < _LASER_REACH for bias in biases):
        raise DataError(f"{path}: a bias is none of a laser")
    return biases


def _camera_to_px4(settings: Path, robot: str) -> Floats:
    """Rotation from the camera's IMU to px4, through the camera, to which both are calibrated."""
    folder = settings / "realsense" / robot
    px4, camera = (_rotation(folder / f"extrinsics_{imu}imu.yaml") for imu in ("px4", "cam"))
    return px4.T @ camera


def _rotation(path: Path) -> Floats:
    """IMU to camera."""
    camera = _entry(path, "cam0")
    try:
        matrix = np.array(camera["T_cam_imu"], float)[:3, :3]
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise _config_error(path, error) from None
    if matrix.shape != (3, 3) or not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-6):
        raise DataError(f"{path}: T_cam_imu holds no rotation")
    return matrix


def _entry(path: Path, key: str) -> Any:
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            return yaml.safe_load(file)[key]
    except (OSError, ValueError, KeyError, TypeError, RecursionError, yaml.YAMLError) as error:
        raise _config_error(path, error) from None


def _config_error(path: Path, error: Exception) -> DataError:
    if isinstance(error, FileNotFoundError):
        return DataError(f"{path}: no such file")
    what = f"no entry {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
    return DataError(f"{path}: not a MILUV configuration: {what}")
