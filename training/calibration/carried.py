"""Time differences, angles of arrival and optical flow, against truth."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from coloc_env.datasets.noise_model import AngleModel, FlowModel, NoiseModel, TdoaModel
from coloc_env.datasets.recording import Flags, Floats, Recording, Table
from coloc_env.datasets.residuals import pose_at, tag_at
from training.calibration.noise import Noise, noise_of, pooled

_FEW = 10
_HALF = 50_000_000  # ns to either side, over which a velocity is that of the truth

Errors = tuple[Floats, Flags]  # [T, F], and where the truth is known


def calibrate_carried(
    recording: Recording, model: NoiseModel
) -> tuple[NoiseModel, dict[str, Noise]]:
    """The model with the deviations that these streams show, and what each number shows."""
    noises: dict[str, Noise] = {}
    if tdoa := _noises(recording, "tdoa", _differences):
        model = replace(model, tdoa=TdoaModel(tdoa[0].white))
        noises["time differences"] = tdoa[0]
    if angles := _noises(recording, "arrival_angles", _angles):
        azimuth, elevation = angles
        own = AngleModel(azimuth.white, elevation.white)
        model = replace(model, arrival_angles=own)
        noises |= {"azimuth": azimuth, "elevation": elevation}
    if flow := _noises(recording, "flow", _flow):
        model = replace(model, flow=FlowModel(pooled(flow, "white")))
        noises |= {"flow forward": flow[0], "flow left": flow[1]}
    return model, noises


def _noises(
    recording: Recording, stream: str, errors_of: Callable[[Recording, int, Table], Errors]
) -> list[Noise]:
    """Of each number of a stream, all robots together; none without truth."""
    times, errors = [], []
    for robot, table in enumerate(recording.streams.get(stream, ())):
        if len(table.time) and len(recording.truth[robot].time) > 1:
            error, known = errors_of(recording, robot, table)
            if known.sum() >= _FEW:
                times.append(table.time[known])
                errors.append(error[known])
    if not errors:
        return []
    found = []
    for column in range(errors[0].shape[1]):
        parts = [noise_of(t, e[:, column]) for t, e in zip(times, errors, strict=True)]
        whole = np.concatenate([e[:, column] for e in errors])
        tail = float(np.average([n.tail for n in parts], weights=[n.count for n in parts]))
        std, white = (pooled(parts, what) for what in ("std", "white"))
        found.append(Noise(len(whole), float(np.median(whole)), std, tail, white))
    return found


def _differences(recording: Recording, robot: int, table: Table) -> Errors:
    """z − (‖t − A_n‖ − ‖t − A_m‖)."""
    tag, m, n = table.values[:, :3].astype(np.int64).T
    place, known = tag_at(recording, robot, tag, table.time)
    far = [np.linalg.norm(place - recording.anchors[end], axis=1) for end in (m, n)]
    return (table.values[:, 3] - (far[1] - far[0]))[:, None], known


def _angles(recording: Recording, robot: int, table: Table) -> Errors:
    """Azimuth and elevation less those of Rᵀ(p_j − p)."""
    position, attitude, known = pose_at(recording.truth[robot], table.time)
    theirs, seen = np.zeros_like(position), table.values[:, 0].astype(np.int64)
    for other in np.unique(seen):
        there = seen == other
        if len(recording.truth[other].time) > 1:
            theirs[there], _, near = pose_at(recording.truth[other], table.time[there])
            known[there] &= near
        else:
            known[there] = False
    v = _in_body(attitude, theirs - position)
    level = np.hypot(v[:, 0], v[:, 1])
    exact = np.stack((np.arctan2(v[:, 1], v[:, 0]), np.arctan2(v[:, 2], level)), 1)
    error = table.values[:, 1:] - exact
    error[:, 0] = (error[:, 0] + np.pi) % (2 * np.pi) - np.pi
    return error, known


def _flow(recording: Recording, robot: int, table: Table) -> Errors:
    """z − (Rᵀ v)_xy, v as the position changes about that time."""
    track = recording.truth[robot]
    _, attitude, known = pose_at(track, table.time)
    ahead, behind = (pose_at(track, table.time + by) for by in (_HALF, -_HALF))
    velocity = (ahead[0] - behind[0]) / (2e-9 * _HALF)
    return table.values - _in_body(attitude, velocity)[:, :2], known & ahead[2] & behind[2]


def _in_body(attitude: Floats, vectors: Floats) -> Floats:
    """World vectors [T, 3] in the body frame, by quaternions [T, 4] wxyz."""
    turned: Floats = Rotation.from_quat(np.roll(attitude, -1, 1)).inv().apply(vectors)
    return turned
