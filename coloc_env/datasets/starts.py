"""Where robots start of which there is no truth."""

from dataclasses import replace

import numpy as np

from coloc_env.datasets.grid import Grid
from coloc_env.datasets.recording import Floats, Recording, Table

_STILL = 1_000_000_000  # ns at the start over which the specific force is averaged


def level(recording: Recording, grid: Grid) -> Recording:
    """With a start for every robot without truth that has an IMU, whose roll and pitch are those
    that its first second of specific force shows (its heading 0), if its start has no attitude."""
    if recording.dim == 2 or recording.tracked or "imu" not in recording.streams:
        return recording
    start = recording.start if len(recording.start) else np.full((len(recording.robots), 7), np.nan)
    start = start.copy()
    for robot, table in enumerate(recording.streams["imu"]):
        if not len(recording.truth[robot].time) and np.isnan(start[robot, 3:]).any():
            start[robot, 3:] = _levelled(table, grid.start)
    return replace(recording, start=start)


def spread_of_start(recording: Recording) -> tuple[bool, bool]:
    """Whether every robot's place at the start is known, and whether its attitude is: from truth,
    or because the recording says it."""
    place, attitude = True, True
    for robot, track in enumerate(recording.truth):
        if len(track.time):
            continue
        known = ~np.isnan(recording.start[robot]) if len(recording.start) else np.zeros(7, bool)
        place &= bool(known[: recording.dim].all())
        attitude &= bool(known[recording.dim :].all())
    return place, attitude


def _levelled(table: Table, start: int) -> Floats:
    """The shortest turn that takes the mean specific force to up; wxyz."""
    early = (table.time >= start) & (table.time <= start + _STILL)
    force = table.values[early, 3:] if early.any() else table.values[:1, 3:]
    up = force.mean(0)
    length = np.linalg.norm(up)
    if not length > 0:
        return np.array((1.0, 0.0, 0.0, 0.0))
    x, y, z = up / length
    # half way between f and e_z: q = (1 + f·e_z, f × e_z) / |…|
    q = np.array((1.0 + z, y, -x, 0.0))
    size = np.linalg.norm(q)
    return q / size if size > 1e-6 else np.array((0.0, 1.0, 0.0, 0.0))
