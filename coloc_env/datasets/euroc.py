"""EuRoC MAV: IMU and full-state truth; sequences of one room, flown "together" as a team."""

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from coloc_env.datasets.files import DataError, FileFormat, Rows, fail, read
from coloc_env.datasets.recording import Floats, Recording, Stamps, Table, Track

SOURCE = (
    "EuRoC MAV; Burri, Nikolic, Gohl, Schneider, Rehder, Omari, Achtelik, Siegwart, "
    "IJRR 35(10):1157-1163, 2016; research use, see ETH ASL for the terms"
)
IMU_COLUMNS = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
_IMU = FileFormat(IMU_COLUMNS, "nanoseconds", ",")
_TRUTH = FileFormat(
    tuple("px py pz qw qx qy qz vx vy vz gbx gby gbz abx aby abz".split()), "nanoseconds", ","
)
# The IMU's axes are up, right, forward; the body's are forward, left, up.
_TO_BODY = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])


def load_euroc(folders: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> Recording:
    """Load one sequence, or several of the same room as one team, a robot each.

    A folder holds ``imu0.csv`` and ``groundtruth.csv``, or is laid out as ETH publishes it
    (``mav0/imu0/data.csv``, ``mav0/state_groundtruth_estimate0/data.csv``). Time zero of each
    sequence is its own first truth; IMU samples before it have negative times. The body frame is
    the IMU's with the axes named anew (z, -y, x become forward, left, up), for IMU, attitude and
    biases alike; "forward" points 22 degrees below the horizon in level flight, as the camera
    does. The truth (200 Hz, but 20 Hz in OpenVINS's V1_01_easy) is itself a batch estimate that
    used the IMU. Stream: imu.

    Measured, with the truth's biases taken off, over 0.1 s: gyro against the truth's rotation, robust
    deviation below 3 mrad/s; accelerometer against its velocity below 0.1 m/s^2.

    Raises:
        DataError: no folder, folders of different rooms (their names differ before the first
            ``_``), a file that is missing or damaged, a quaternion that is not of unit length.
    """
    if isinstance(folders, str | os.PathLike):
        folders = [folders]
    paths = [Path(folder) for folder in folders]
    if len({room(path.name) for path in paths}) != 1:
        names = ", ".join(path.name for path in paths)
        raise DataError(f"EuRoC sequences of one room make a team, these do not: {names or 'none'}")
    tracks, tables = zip(*map(_sequence, paths), strict=True)
    return Recording(
        name="euroc/" + "+".join(path.name for path in paths),
        dim=3,
        robots=tuple(path.name for path in paths),
        truth=tracks,
        streams={"imu": tables},
        landmarks=np.empty((0, 3)),
        anchors=np.empty((0, 3)),
        tags=np.empty((len(paths), 0, 3)),
        source=SOURCE,
    )


def room(sequence: str) -> str:
    """The room a sequence was flown in: the part of its name before the first ``_``."""
    return sequence.split("_")[0]


def _sequence(folder: Path) -> tuple[Track, Table]:
    path = _either(folder, "groundtruth.csv", "mav0/state_groundtruth_estimate0/data.csv")
    truth = read(path, _TRUTH)
    attitude = truth.values[:, 3:7]
    length = np.linalg.norm(attitude, axis=1)
    if (bad := np.abs(length - 1) > 0.01).any():
        fail(path, _TRUTH, bad, f"the quaternion has length {length[bad][0]:.3f}")
    imu = read(_either(folder, "imu0.csv", "mav0/imu0/data.csv"), _IMU)
    zero = truth.time[0]
    return _track(truth, zero), _imu(imu, zero)


def _track(truth: Rows, zero: np.int64) -> Track:
    raise NotImplementedError


def _imu(imu: Rows, zero: np.int64) -> Table:
    raise NotImplementedError
