"""EuRoC MAV: IMU and full-state truth; sequences of one room, replayed "together" as a team."""

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from coloc_env.datasets.files import FileFormat, Rows, distinct, fail, read
from coloc_env.datasets.recording import (
    IMU_COLUMNS,
    DataError,
    Recording,
    Table,
    Track,
    one_hemisphere,
)

SOURCE = (
    "EuRoC MAV; Burri, Nikolic, Gohl, Schneider, Rehder, Omari, Achtelik, Siegwart, "
    "IJRR 35(10):1157-1163, 2016; research use, see ETH ASL for the terms"
)
_IMU = FileFormat(IMU_COLUMNS, "nanoseconds", ",")
_TRUTH = FileFormat(
    (
        *("position_x", "position_y", "position_z"),
        *("quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"),
        *("velocity_x", "velocity_y", "velocity_z"),
        *("gyro_bias_x", "gyro_bias_y", "gyro_bias_z"),
        *("accel_bias_x", "accel_bias_y", "accel_bias_z"),
    ),
    "nanoseconds",
    ",",
)
# The IMU's axes are up, right, forward; the body's are forward, left, up: half a turn about
# (1, 0, 1). _TURN is the product with its quaternion (0, 1, 0, 1)/sqrt(2) from the right.
_TO_BODY = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
_TURN = np.sqrt(0.5) * np.array(
    [[0.0, 1.0, 0.0, 1.0], [-1.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, -1.0], [-1.0, 0.0, 1.0, 0.0]]
)


def load_euroc(folders: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> Recording:
    """Load one sequence, or several of the same room as one team, a robot each.

    A folder holds ``imu0.csv`` and ``groundtruth.csv``, or is laid out as ETH publishes it
    (``mav0/imu0/data.csv``, ``mav0/state_groundtruth_estimate0/data.csv``). Time zero of each
    sequence is its own first truth; IMU samples before it have negative times. The body frame is
    the IMU's with the axes renamed (z, -y, x become forward, left, up), for IMU, attitude and
    biases alike; "forward" points 22 degrees below the horizon in level flight, as the camera
    does. The truth (200 Hz, but 20 Hz in OpenVINS's V1_01_easy) is itself a batch estimate that
    used the IMU. Stream: imu.

    Measured over 0.1 s, biases as in the truth taken off, sensor minus truth, robust deviation a
    axis: gyro 1 to 2 mrad/s, accelerometer 0.02 to 0.05 m/s^2, no bias beyond 0.04.

    Raises:
        DataError: no folder, the same one twice, folders of different rooms (names that differ
            before the first ``_``), a file that is missing or damaged.
    """
    if isinstance(folders, str | os.PathLike):
        folders = [folders]
    paths = [Path(folder) for folder in folders]
    names = tuple(path.name for path in paths)
    if len(set(map(room, names))) != 1 or len(set(names)) != len(names):
        given = ", ".join(names) or "none"
        raise DataError(f"a EuRoC team consists of different sequences of one room, not {given}")
    tracks, tables = zip(*map(_sequence, paths), strict=True)
    return Recording(
        name="euroc/" + "+".join(names),
        dim=3,
        robots=names,
        truth=tracks,
        streams={"imu": tables},
        landmarks=np.empty((0, 3)),
        anchors=np.empty((0, 3)),
        tags=np.empty((len(paths), 0, 3)),
        source=SOURCE,
    )


def robots_in(folder: Path) -> tuple[str, ...]:
    """The one robot of a sequence, which is called like it; its files may be incomplete."""
    files = (_truth_file(folder), _imu_file(folder))
    return (folder.name,) if any(file.is_file() for file in files) else ()


def room(sequence: str) -> str:
    """The room a sequence was recorded in: the part of its name before the first ``_``."""
    return sequence.split("_")[0]


def _sequence(folder: Path) -> tuple[Track, Table]:
    path = _truth_file(folder)
    truth = read(path, _TRUTH)
    length = np.linalg.norm(truth.values[:, 3:7], axis=1)
    if (bad := np.abs(length - 1) > 0.01).any():
        fail(path, _TRUTH, bad, f"the quaternion has length {length[bad][0]:.3f}, not 1")
    imu = read(_imu_file(folder), _IMU)
    turned = np.concatenate((imu.values[:, :3] @ _TO_BODY.T, imu.values[:, 3:] @ _TO_BODY.T), 1)
    return _track(truth), Table(imu.time - truth.time[0], turned, IMU_COLUMNS)


def _truth_file(folder: Path) -> Path:
    return _either(folder, "mav0/state_groundtruth_estimate0/data.csv", "groundtruth.csv")


def _imu_file(folder: Path) -> Path:
    return _either(folder, "mav0/imu0/data.csv", "imu0.csv")


def _either(folder: Path, published: str, plain: str) -> Path:
    """The file as ETH publishes it where it exists, else the plain one."""
    return folder / published if (folder / published).is_file() else folder / plain


def _track(truth: Rows) -> Track:
    time, values = distinct(truth)
    attitude = values[:, 3:7] @ _TURN
    return Track(
        time=time - time[0],
        position=values[:, :3],
        attitude=one_hemisphere(attitude / np.linalg.norm(attitude, axis=1, keepdims=True)),
        velocity=values[:, 7:10],
        gyro_bias=values[:, 10:13] @ _TO_BODY.T,
        accel_bias=values[:, 13:16] @ _TO_BODY.T,
    )
