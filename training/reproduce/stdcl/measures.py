"""The paper's measures: NRMSE, formation geometry, drift and restlessness; and against bounds."""

import numpy as np

from coloc_env.bounds import Bound
from training.evaluation import metrics
from training.evaluation.metrics import Floats
from training.reproduce.measures import rmse, rmse_of_all
from training.reproduce.results import Runs
from training.reproduce.verdicts import gain_in

START, END = slice(10, 110), slice(-100, None)  # steps of a long run that are compared
better = gain_in(rmse)  # by how many per cent the RMSE is lower


def radius(one: Runs) -> float:
    """The network's reach R in m, by which the paper divides errors; NaN without one."""
    reach = one.evaluation.scenario.network.radius
    return float("nan") if reach is None else reach


def nrmse(one: Runs) -> Floats:
    """[R]: equation 41."""
    return rmse(one) / radius(one)


def ate(one: Runs) -> Floats:
    """[R]: root mean square over a UAV's steps, mean over UAVs, m."""
    tracks = metrics.rmse_per_track(one.error, one.scored)
    return np.array([metrics.mean(run) for run in tracks])


def fge(one: Runs) -> Floats:
    """[R]: error of the distances between UAVs, m."""
    truth, offset, scored = one.truth, one.record.offset, one.scored
    each = (slice(r, r + 1) for r in range(len(truth)))
    return np.array([metrics.formation_error(truth[r], offset[r], scored[r]) for r in each])


def drift(one: Runs) -> Floats:
    """[R]: RMSE of the last hundred steps as a multiple of that of steps 10 to 110; NaN for runs
    too short to have both."""
    if one.steps < START.stop - END.start:
        return np.full(len(one.error), np.nan)
    first, last = (
        metrics.rmse_per_run(one.error[:, part], one.scored[:, part]) for part in (START, END)
    )
    return last / first


def restless(one: Runs) -> Floats:
    """[R]: standard deviation over steps of the team's RMS error, m; the first ten, which settle,
    aside."""
    settled = slice(min(10, one.steps // 2), None)
    error, scored = one.error[:, settled], one.scored[:, settled]
    squares = np.where(scored, error.astype(np.float64), 0.0) ** 2
    return np.sqrt(squares.sum(2) / np.maximum(scored.sum(2), 1)).std(1)


def ratio_to(one: Runs, bound: Bound | None) -> float:
    """RMSE as a multiple of a bound's over the bound's own runs, where it is finite."""
    if bound is None or len(bound.mse) > len(one.error):
        return float("nan")
    mse, scored = bound.mse.numpy(), bound.scored.numpy()
    known = scored & np.isfinite(mse)
    if not known.any():
        return float("nan")
    return metrics.rmse(one.error[: len(mse)], known) / float(np.sqrt(mse[known].mean()))


def ratio_to_alone(one: Runs, alone: Runs | None) -> float:
    """RMSE as a multiple of dead reckoning's in the same worlds."""
    if alone is None:
        return float("nan")
    count = min(len(one.error), len(alone.error))
    a, b = (metrics.rmse(x.error[:count], x.scored[:count]) for x in (one, alone))
    return a / b


def nrmse_of_all(one: Runs) -> float:
    """NRMSE over all runs."""
    return rmse_of_all(one) / radius(one)
