"""``replay-…-v0``: real recordings through the same world, faces and localizers.

The data are their owners' and not part of this package: see ``coloc_env.datasets``. Loading is lazy
(at ``make_scenario``) and parsing is cached on disk.
"""

from functools import lru_cache
from typing import Any

import numpy as np

from coloc_env.datasets import Recording, load
from coloc_env.datasets.euroc import room
from coloc_env.datasets.folders import Version, dataset_folder, version
from coloc_env.datasets.grid import Grid
from coloc_env.datasets.recording import Floats
from coloc_env.scenario import Inertial

# Means of the bias states that the ground truths of two flights carry, each in a building of its
# own: a room's flights are corrected by the one elsewhere, of the same vehicle, so that no segment
# is calibrated on itself. Gyro (rad/s), accelerometer (m/s²), FLU body.
_MH_04 = (0.07665, -0.02107, -0.00214, 0.0595, -0.1371, -0.0273)
_V1_03 = (0.07660, -0.02181, -0.00235, 0.0896, -0.1795, -0.0237)


def euroc_bias(recording: Recording) -> Floats:
    """The IMU's calibrated bias [N, 6] for a team of one room."""
    bias = _V1_03 if room(recording.robots[0]) == "MH" else _MH_04
    return np.tile(bias, (len(recording.robots), 1))


# What is left of the bias: prior and walk wide enough for what a calibration flight cannot know.
LEFT_OVER = Inertial(0.1, 0.003, accel_walk=0.01, gyro_walk=1e-4)


def cut(grid: Grid, span: tuple[float, float] | None) -> Grid:
    """The part of a recording from ``span[0]`` to ``span[1]`` s after its common start."""
    if span is None:
        return grid
    first, last = (round(max(-1.0, min(s / grid.dt, grid.count - 1.0))) for s in span)
    if not 0 <= first < last:
        raise ValueError(
            f"span={span} is not allowed: (from, to) in s within 0 and {grid.count * grid.dt:.1f}"
        )
    return Grid(int(grid.times[first]), grid.dt, last - first + 1)


def loaded(name: str, sequence: str | None, data: str | None, **options: Any) -> Recording:
    """A recording, kept for the next scenario made of it until a file of its dataset changes."""
    known = version(dataset_folder(name, data))
    return _loaded(known, name, sequence, data, **options)


@lru_cache(maxsize=4)
def _loaded(
    known: Version, name: str, sequence: str | None, data: str | None, **options: Any
) -> Recording:
    return load(name, sequence, data, **options)
