"""The last word on how noisy everything is: what a filter does best with, on the part that is
learnt from.

Errors that last, and motion that is no white noise, are what no variance says; two factors, of all
that is measured and of all that drives the motion, are tried one after the other.
"""

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from agents import make
from coloc_env.datasets.noise_model import NoiseModel, write_noise_model
from coloc_env.scenarios import make_scenario
from training.evaluation.metrics import rmse
from training.evaluation.record import record

MEASURED, MOTION = (0.5, 0.7, 1.0, 1.4, 2.0), (0.5, 1.0, 2.0, 4.0)
_BETTER = 0.97  # of the error: what is no better than this is left
_RUNS = 5  # draws of the prior
_DRIVERS = {
    "odometry": ("forward_std", "left_std", "turn_std", "relative"),
    "imu": ("accel_std", "gyro_std"),
    "motion": ("accel_std",),
}
_SENSORS = {
    "anchor_ranges": ("std",),
    "uav_ranges": ("std",),
    "landmark_bearings": ("range_std", "bearing_std"),
    "uav_bearings": ("range_std", "bearing_std"),
    "landmark_vectors": ("std",),
    "tdoa": ("std",),
    "arrival_angles": ("azimuth_std", "elevation_std"),
    "flow": ("std",),
    "height": ("std",),
    "position_fix": ("std", "vertical_std"),
}
Progress = Callable[[str, int, int], None]


def tuned(
    model: NoiseModel,
    folder: Path,
    agent: str,
    progress: Progress = lambda what, done, total: None,
    **overrides: Any,
) -> tuple[NoiseModel, tuple[str, ...]]:
    """The model with both factors, and words about what they do to an agent's error.

    ``overrides`` of ``replay-v0``: the span that is learnt from, its dt. Raises ValueError for an
    agent or override that does not exist.
    """
    done, total = 0, len(MEASURED) + len(MOTION) - 1

    def error(tried: NoiseModel) -> float:
        nonlocal done
        progress(agent, done, total)
        done += 1
        return error_of(tried, folder, agent, **overrides)

    first = least = error(model)
    for what, factors in ((_DRIVERS, MOTION), (_SENSORS, MEASURED)):
        best = model
        for factor in factors:
            if factor != 1.0:
                now = error(scaled(model, what, factor))
                if now < _BETTER * least:
                    best, least = scaled(model, what, factor), now
        model = best
    words = (
        f"{agent} on the part learnt from: {first:.3f} m before factors, {least:.3f} m with them"
    )
    return model, (words,)


def error_of(model: NoiseModel, folder: Path, agent: str, **overrides: Any) -> float:
    """RMSE (m) of an agent that believes a model, over some draws of the prior."""
    with TemporaryDirectory() as scratch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(scratch) / "believed.yaml"
        path.write_text(write_noise_model(model), encoding="utf-8")
        scenario = make_scenario("replay-v0", path=str(folder), believed=str(path), **overrides)
        found = record(make(agent, scenario), scenario, torch.arange(_RUNS))
    value = rmse(found.error, found.worlds.scored)
    return value if np.isfinite(value) and not found.broken.any() else float("inf")


def scaled(model: NoiseModel, parts: dict[str, tuple[str, ...]], factor: float) -> NoiseModel:
    """The model with the deviations of some parts multiplied."""
    changed = {
        part: replace(own, **{name: factor * getattr(own, name) for name in names})
        for part, names in parts.items()
        for own in (getattr(model, part),)
    }
    return replace(model, **changed)
