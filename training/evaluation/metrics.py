"""Figures of merit from arrays [runs R, steps K, UAVs N]; lengths in m.

``error`` is ‖p̂ − p‖, ``offset`` the vector p̂ − p [R, K, N, d], ``scored`` says which entries
count. Where nothing counts the answer is NaN.
"""

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Floats = NDArray[np.floating]
Flags = NDArray[np.bool_]

LOST_SECONDS = 5.0
LOST_SHARE = 0.1


def rmse(error: Floats, scored: Flags) -> float:
    """Root mean square over runs, steps and UAVs."""
    return float(_root_mean(_squares(error, scored), scored, None))


def rmse_per_run(error: Floats, scored: Flags) -> Floats:
    """[R], over steps and UAVs."""
    return _root_mean(_squares(error, scored), scored, (1, 2))


def rmse_per_uav(error: Floats, scored: Flags) -> Floats:
    """[N], over runs and steps."""
    return _root_mean(_squares(error, scored), scored, (0, 1))


def rmse_per_step(error: Floats, scored: Flags) -> Floats:
    """[K], over runs and UAVs."""
    return _root_mean(_squares(error, scored), scored, (0, 2))


def mean_per_step(values: Floats, scored: Flags) -> Floats:
    """[K], over runs and UAVs, of what is scored and not NaN."""
    counts = scored & ~np.isnan(values)
    total = np.where(counts, values, 0.0).sum((0, 2), dtype=np.float64)
    number = counts.sum((0, 2))
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def rmse_per_track(error: Floats, scored: Flags) -> Floats:
    """[R, N], over steps: the absolute trajectory error of each UAV, without alignment."""
    return _root_mean(_squares(error, scored), scored, 1)


def rmse_after(error: Floats, scored: Flags, dt: float, seconds: float) -> float:
    """Root mean square over the steps from ``seconds`` on; step k is at k · ``dt``."""
    late = np.arange(error.shape[1]) * dt >= seconds - 1e-9
    return rmse(error[:, late], scored[:, late])


def largest(error: Floats, scored: Flags) -> float:
    """Mean over runs and UAVs of each one's largest error."""
    tracks = scored.any(1)
    return mean(np.where(scored, error, 0.0).max(1)[tracks])


def ate(error: Floats, scored: Flags) -> float:
    """Absolute trajectory error without alignment, mean over runs and UAVs."""
    return mean(rmse_per_track(error, scored)[scored.any(1)])


def rpe(offset: Floats, scored: Flags, steps: int) -> float:
    """Relative pose error: root mean square error of the displacement over ``steps``."""
    difference = offset[:, steps:].astype(np.float64) - offset[:, :-steps]
    return rmse(np.linalg.norm(difference, axis=-1), scored[:, steps:] & scored[:, :-steps])


def relative_error(offset: Floats, scored: Flags) -> float:
    """Root mean square error of the vectors from UAV to UAV, over all pairs scored at once.

    Uses Σ_{i<j} ‖e_j − e_i‖² = n Σ ‖e_i − ē‖².
    """
    count = scored.sum(-1)
    kept = np.where(scored[..., None], offset, 0.0).astype(np.float64)
    centre = kept.sum(-2, keepdims=True) / np.maximum(count, 1)[..., None, None]
    spread = (((kept - centre) ** 2).sum(-1) * scored).sum(-1)
    pairs = (count * (count - 1) // 2).sum()
    return float(np.sqrt((count * spread).sum() / pairs)) if pairs else float("nan")


def formation_error(truth: Floats, offset: Floats, scored: Flags) -> float:
    """Root mean square error of the distances between UAVs, over all pairs scored at once."""
    estimate, total, pairs = truth + offset, 0.0, 0
    for i in range(truth.shape[2] - 1):
        both = scored[:, :, i + 1 :] & scored[:, :, i, None]
        true, estimated = (
            np.linalg.norm(p[:, :, i + 1 :] - p[:, :, i, None], axis=-1) for p in (truth, estimate)
        )
        total += float(((estimated - true)[both] ** 2).sum())
        pairs += int(both.sum())
    return float(np.sqrt(total / pairs)) if pairs else float("nan")


def per_run(values: Floats, scored: Flags) -> float:
    """Sum over the steps of a run, mean over runs and UAVs; NaN counts as nothing."""
    total = np.where(scored & ~np.isnan(values), values, 0.0).sum(1, dtype=np.float64)
    return mean(total[scored.any(1)])


def mean_per_run(values: Floats, counts: Flags) -> Floats:
    """[R]: mean over steps and UAVs of what counts and is not NaN."""
    kept = np.where(counts, values, np.nan)
    return np.array([mean(run) for run in kept])


def lost(error: Floats, scored: Flags, dt: float, threshold: float) -> Flags:
    """[R, N]: whether a UAV ends lost, that is, its error exceeds ``threshold`` in every one of the
    last 5 s of steps in which it is scored (all of them, if there are fewer)."""
    left = np.flip(np.cumsum(np.flip(scored, 1), 1), 1)
    last = scored & (left <= max(1, round(LOST_SECONDS / dt)))
    return (last & (error > threshold)).sum(1) == np.maximum(last.sum(1), 1)


def nees_band(dim: int, count: int, level: float = 0.95) -> tuple[float, float]:
    """Where the mean of ``count`` independent NEES of a consistent estimator lies."""
    tail = 0.5 * (1 - level)
    low, high = stats.chi2.ppf((tail, 1 - tail), dim * count) / count
    return float(low), float(high)


def nees_bands(dim: int, scored: Flags) -> tuple[Floats, Floats]:
    """Lower and upper end [K] of ``nees_band`` at each step; NaN where nothing is scored."""
    counts = scored.sum((0, 2)).tolist()
    bands = {n: nees_band(dim, n) if n else (np.nan, np.nan) for n in set(counts)}
    low, high = np.array([bands[n] for n in counts]).T
    return low, high


@dataclass(frozen=True)
class Difference:
    """Mean of paired differences with the ends of its confidence interval."""

    mean: float
    low: float
    high: float


def paired_difference(a: Floats, b: Floats, level: float = 0.95) -> Difference:
    """Mean of a − b over runs with Student's interval; infinite for a single run."""
    difference = np.asarray(a, np.float64) - np.asarray(b, np.float64)
    difference = difference[np.isfinite(difference)]
    centre, count = mean(difference), len(difference)
    if count < 2:
        return Difference(centre, -float("inf"), float("inf"))
    half = stats.t.ppf(0.5 * (1 + level), count - 1) * difference.std(ddof=1) / np.sqrt(count)
    return Difference(centre, float(centre - half), float(centre + half))


def mean(values: Floats) -> float:
    """Mean of the values that are not NaN."""
    values = values[~np.isnan(values)]
    return float(values.mean(dtype=np.float64)) if values.size else float("nan")


def _squares(error: Floats, scored: Flags) -> NDArray[np.float64]:
    return np.where(scored, error.astype(np.float64), 0.0) ** 2


def _root_mean(
    squares: NDArray[np.float64], scored: Flags, axes: int | tuple[int, ...] | None
) -> NDArray[np.float64]:
    with warnings.catch_warnings(), np.errstate(invalid="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.sqrt(squares.sum(axes) / scored.sum(axes))
