"""Everything that a recording shows of its sensors, as a noise model that filters believe in."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from coloc_env.datasets.noise_model import MotionModel, NoiseModel
from coloc_env.datasets.recording import Floats, Recording, Table, Track
from training.calibration.carried import calibrate_carried
from training.calibration.inertial import calibrate_imu
from training.calibration.noise import Noise
from training.calibration.places import refined_anchors, refined_arms
from training.calibration.ranges import calibrate_ranges
from training.calibration.sightings import calibrate_heights, calibrate_sightings
from training.calibration.smoother import smoothed
from training.calibration.wheels import calibrate_odometry

_DT = 0.1  # s, of the steps over which speeds are believed in
_LAG = 0.5  # s
_SMOOTHED = 2  # times: the second with the noise that the first has shown


@dataclass(frozen=True)
class Calibration:
    """The model, what each link and sensor showed, and what else is worth knowing."""

    model: NoiseModel
    noises: dict[str, Noise]
    notes: tuple[str, ...] = ()


def calibrate(recording: Recording, *, motion: str = "auto") -> Calibration:
    """Calibrate every sensor of a recording against its truth or, where no robot has any, against
    the team's own smoothed estimate.

    Without truth noise that lasts hides in the estimate, so deviations come out too small; and
    anchors, lever arms and odometry, which the estimate follows, are left as they are.

    Raises:
        DataError: there is neither truth nor anything that shows where anybody is.
    """
    if not any(len(track.time) > 1 for track in recording.truth):
        return _without_truth(recording, motion)
    model = NoiseModel()
    noises: dict[str, Noise] = {}
    for stream in ("anchor_ranges", "uav_ranges"):
        found = calibrate_ranges(recording, stream)
        if found is not None:
            model = _with(model, stream, found[0])
            noises |= found[1]
    if "anchor_ranges" in recording.streams:
        anchors = refined_anchors(recording, model.anchor_ranges)
        tags = refined_arms(recording, model.anchor_ranges)
        model = replace(model, anchors=anchors, tags=tags)
    for stream in ("landmark_bearings", "uav_bearings"):
        if stream in recording.streams:
            seen = calibrate_sightings(recording, stream)
            if seen is not None:
                model = _with(model, stream, seen[0])
                noises |= {f"{name} ({stream})": noise for name, noise in seen[1].items()}
    if "height" in recording.streams:
        height = calibrate_heights(recording)
        if height is not None:
            model = replace(model, height=replace(model.height, std=height.white, bias=height.bias))
            noises["height"] = height
    model, shown = calibrate_carried(recording, model)
    noises |= shown
    wheels = calibrate_odometry(recording)
    if wheels is not None:
        model = replace(model, odometry=wheels)
    if "imu" in recording.streams:
        imu = calibrate_imu(recording)
        if imu is not None:
            model = replace(model, imu=imu)
    return Calibration(replace(model, motion=calibrate_motion(recording, motion)), noises)


def _without_truth(recording: Recording, motion: str) -> Calibration:
    """Smooth by what is believed, calibrate against that, and smooth again."""
    model, found = NoiseModel(), None
    for _ in range(_SMOOTHED):
        steady = smoothed(recording, model)
        found = calibrate(replace(steady, tags=np.zeros_like(steady.tags)), motion=motion)
        model = replace(found.model, anchors={}, tags={}, odometry=NoiseModel().odometry)
        # an estimate without attitudes shows nothing of what is in the body frame
        own = NoiseModel()
        model = replace(model, arrival_angles=own.arrival_angles, flow=own.flow)
    assert found is not None
    note = "no truth: calibrated against the team's own smoothed estimate; deviations are too small"
    return replace(found, model=model, notes=(note,))


def calibrate_motion(recording: Recording, motion: str = "auto") -> MotionModel:
    """How the team moves by its truth: white acceleration, and the speed that is usual.

    q = √(Var Δv / T) over T = 0.5 s. The usual speed, believed again at each step, counts as often
    as it is believed: σ √(2 τ/dt), τ the time that a velocity lasts.
    """
    gained, speeds, lasting = [], [], []
    for track in recording.truth:
        if len(track.time) < 50:
            continue
        time = np.arange(track.time[0], track.time[-1], round(_LAG * 1e9))
        velocity = np.diff(_positions(track, time), axis=0) / _LAG
        gained.append(np.diff(velocity, axis=0).ravel())
        speeds.append(velocity.ravel())
        power = float((velocity**2).mean())
        if power > 0:
            along = float((velocity[1:] * velocity[:-1]).mean()) / power
            lasting.append(-_LAG / np.log(min(max(along, 0.05), 0.98)))
    if not gained:
        return MotionModel(motion)
    # mean velocities over T differ by less than velocities T apart: Var is ⅔ q² T
    accel = float(np.sqrt((np.concatenate(gained) ** 2).mean() / (2 / 3 * _LAG)))
    usual = float(np.sqrt((np.concatenate(speeds) ** 2).mean()))
    slow = usual * float(np.sqrt(2 * np.median(lasting) / _DT)) if lasting else 0.0
    inertial = "imu" in recording.streams and recording.dim == 3
    return MotionModel(motion, max(accel, 0.01), 0.0, slow if inertial else 0.0)


def part_of(recording: Recording, span: tuple[float, float]) -> Recording:
    """What was recorded from one time to another, in s after the start."""
    every = [t for team in recording.streams.values() for t in team] + list(recording.truth)
    zero = min(int(each.time[0]) for each in every if len(each.time))
    first, last = (zero + round(at * 1e9) for at in span)

    def cut(table: Table) -> Table:
        there = (table.time >= first) & (table.time <= last)
        return Table(table.time[there], table.values[there], table.columns)

    def cut_track(track: Track) -> Track:
        there = (track.time >= first) & (track.time <= last)
        parts: dict[str, Floats | None] = {
            name: None if (x := getattr(track, name)) is None else x[there]
            for name in ("position", "attitude", "velocity", "gyro_bias", "accel_bias")
        }
        return Track(track.time[there], **parts)  # type: ignore[arg-type]

    return replace(
        recording,
        truth=tuple(map(cut_track, recording.truth)),
        streams={name: tuple(map(cut, team)) for name, team in recording.streams.items()},
        points=tuple(map(cut, recording.points)),
    )


def _with(model: NoiseModel, stream: str, part: Any) -> NoiseModel:
    return replace(model, **{stream: part})


def _positions(track: Track, time: np.ndarray) -> Floats:
    x, xp = (time - track.time[0]) * 1e-9, (track.time - track.time[0]) * 1e-9
    return np.stack([np.interp(x, xp, column) for column in track.position.T], 1)
