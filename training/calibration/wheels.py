"""Odometry against truth: scales, delay and noise."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from coloc_env.datasets.grid import Grid, odometry_on
from coloc_env.datasets.noise_model import OdometryModel
from coloc_env.datasets.recording import Floats, Recording, Table, Track
from coloc_env.datasets.residuals import FALLS, pose_at

_DT = 0.1  # s, of the steps whose noise is estimated
_WINDOW = 10  # steps over which displacements are compared
_DELAYS = np.arange(-0.5, 0.501, 0.05)  # s
_CLIP = 4.0
_LEAST = 0.005  # m/s, rad/s


@dataclass(frozen=True)
class _Moved:
    """Displacements over windows [T, 3] (forward, left, turn): by the odometry, by the truth."""

    read: Floats
    true: Floats


def calibrate_odometry(recording: Recording) -> OdometryModel | None:
    """The odometry's model, of all robots together; None without truth beside it."""
    if recording.dim == 3 or "odometry" not in recording.streams:
        return None
    robots = [
        (recording.streams["odometry"][i], track)
        for i, track in enumerate(recording.truth)
        if len(track.time) > 1 and len(recording.streams["odometry"][i].time) > 1
    ]
    if not robots:
        return None
    delay, moved = 0.0, _all_compared(robots, 0.0)
    if moved is None:
        return None
    # What a delay must bring the misfit below: steady motion shows none, and of n windows one fits
    # better by up to 2/√n by chance.
    least = min(FALLS, 1 - 2 * len(moved.read) ** -0.5) * _misfit(moved)
    for other in _DELAYS:
        each = _all_compared(robots, float(other))
        if each is not None and (misfit := _misfit(each)) < least:
            delay, least, moved = float(other), misfit, each
    scale, turn_scale = _scale(moved, 0), _scale(moved, 2)
    error = moved.true - moved.read * (scale, scale, turn_scale)
    lasted = _WINDOW * _DT
    forward, slip = _noise(error[:, 0], moved.read[:, 0] / lasted, lasted)
    turn, skid = _noise(error[:, 2], moved.read[:, 2] / lasted, lasted)
    left, _ = _noise(error[:, 1], np.zeros(len(error)), lasted)
    relative = float(np.sqrt(0.5 * (slip**2 + skid**2)))
    return OdometryModel(scale, turn_scale, delay, forward, left, turn, relative)


def _all_compared(robots: list[tuple[Table, Track]], delay: float) -> _Moved | None:
    """Displacements of all robots; None where none has truth for long enough."""
    each = [_compared(table, track, delay) for table, track in robots]
    there = [moved for moved in each if moved is not None]
    if not there:
        return None
    read, true = (np.concatenate([getattr(m, name) for m in there]) for name in ("read", "true"))
    return _Moved(read, true)


def _compared(table: Table, track: Track, delay: float) -> _Moved | None:
    """Displacements of one robot over windows in which it has truth."""
    start = max(track.time[0], table.time[0] + 10**9)
    end = min(track.time[-1], table.time[-1] - 10**9)
    count = int((end - start) * 1e-9 / _DT)
    if count < 5 * _WINDOW:
        return None
    grid = Grid(int(start), _DT, count)
    acting = Table(table.time + round(delay * 1e9), table.values, table.columns)
    steps = odometry_on(grid, acting) * _DT
    position, heading, known = pose_at(track, grid.times)
    at = np.arange(0, count - _WINDOW, _WINDOW)
    there = known[at] & known[at + _WINDOW]
    read = _composed(np.stack([steps[at + 1 + i] for i in range(_WINDOW)], 1))
    apart = position[at + _WINDOW] - position[at]
    c, s = np.cos(heading[at, 0]), np.sin(heading[at, 0])
    turn = (heading[at + _WINDOW, 0] - heading[at, 0] + np.pi) % (2 * np.pi) - np.pi
    true = np.stack(
        (c * apart[:, 0] + s * apart[:, 1], -s * apart[:, 0] + c * apart[:, 1], turn), 1
    )
    return _Moved(read[there], true[there])


def _composed(steps: Floats) -> Floats:
    """Successive displacements [T, W, 3] as one."""
    total = np.zeros((len(steps), 3))
    for i in range(steps.shape[1]):
        c, s = np.cos(total[:, 2]), np.sin(total[:, 2])
        x, y, turn = steps[:, i].T
        total += np.stack((c * x - s * y, s * x + c * y, turn), 1)
    return total


def _misfit(moved: _Moved) -> float:
    """Mean absolute error of travel and turn after scaling."""
    return sum(
        float(np.abs(moved.true[:, i] - _scale(moved, i) * moved.read[:, i]).mean()) for i in (0, 2)
    )


def _scale(moved: _Moved, column: int) -> float:
    """Least squares' scale of what was driven to what was read: unbiased in the sum, which is what
    dead reckoning adds up, also where vehicles are held up now and then."""
    x, y = moved.read[:, column], moved.true[:, column]
    power = float((x * x).sum())
    scale = float((x * y).sum()) / power if power > 1e-9 else 1.0
    return scale if 0.2 < scale < 5 else 1.0


def _noise(error: Floats, rate: Floats, lasted: float) -> tuple[float, float]:
    """σ of a step's mean rate, and what each unit of rate adds: Var = (σ² + r² rate²) dt T."""
    spread = 1.4826 * np.median(np.abs(error)) + 1e-6
    kept = error.clip(-_CLIP * spread, _CLIP * spread) if spread > 1e-5 else error
    a = np.stack((np.ones(len(error)), rate**2), 1) * (_DT * lasted)
    (base, slope), _ = nnls(a, kept**2)
    return max(float(base**0.5), _LEAST), float(slope**0.5)
