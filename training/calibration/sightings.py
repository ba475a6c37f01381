"""Ranges and bearings of what cameras identify, against truth."""

import numpy as np

from coloc_env.datasets.noise_model import BearingModel, SightingBias
from coloc_env.datasets.recording import Flags, Recording, Stamps
from coloc_env.datasets.residuals import pose_at, sighting_residuals
from training.calibration.noise import Noise, noise_of, pooled, shrunk

_FEW = 10
_STEP = 100_000_000  # ns


def calibrate_sightings(
    recording: Recording, stream: str
) -> tuple[BearingModel, dict[str, Noise]] | None:
    """The model of a stream of range and bearing, of each robot's camera; None without truth."""
    ranges: dict[str, Noise] = {}
    bearings: dict[str, Noise] = {}
    for robot, name in enumerate(recording.robots):
        table = recording.streams[stream][robot]
        if not len(table.time) or not len(recording.truth[robot].time):
            continue
        residual, known = sighting_residuals(recording, stream, robot)
        if known.sum() < _FEW:
            continue
        ranges[name] = noise_of(table.time[known], residual[known, 0])
        bearings[name] = noise_of(table.time[known], residual[known, 1])
    if not ranges:
        return None
    model = BearingModel(
        pooled(list(ranges.values()), "white"),
        pooled(list(bearings.values()), "white"),
        {
            name: SightingBias(r, b)
            for name, r, b in zip(
                ranges, shrunk(list(ranges.values())), shrunk(list(bearings.values())), strict=True
            )
        },
    )
    seen = {f"{name} range": noise for name, noise in ranges.items()}
    return model, seen | {f"{name} bearing": noise for name, noise in bearings.items()}


def calibrate_heights(recording: Recording) -> Noise | None:
    """Heights against truth, of all robots together."""
    times, errors = [], []
    for robot, table in enumerate(recording.streams["height"]):
        track = recording.truth[robot]
        if len(table.time) and len(track.time) > 1:
            position, _, known = pose_at(track, table.time)
            used = known & _newest(table.time)
            times.append(table.time[used])
            errors.append((table.values[:, 0] - position[:, 2])[used])
    parts = [noise_of(t, e) for t, e in zip(times, errors, strict=True) if len(t) >= _FEW]
    if not parts:
        return None
    whole = np.concatenate(errors)
    bias = float(np.median(whole))
    return Noise(len(whole), bias, pooled(parts, "std"), 0.0, pooled(parts, "white"))


def _newest(time: Stamps) -> Flags:
    """The last sample of each step of 0.1 s: what a filter is given."""
    step = (time - time[0]) // _STEP
    return np.append(np.diff(step) > 0, True)
