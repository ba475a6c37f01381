"""Measures of an agent's runs that papers share: one number a run [R], or a series [K]."""

from collections.abc import Callable

import numpy as np

from coloc_env.bounds import Bound, SnapshotBound
from training.evaluation import metrics
from training.evaluation.metrics import Floats
from training.reproduce.results import Runs


def rmse(one: Runs) -> Floats:
    """[R]: over steps and UAVs, m."""
    return metrics.rmse_per_run(one.error, one.scored)


def mean_error(one: Runs) -> Floats:
    """[R]: over steps and UAVs, m."""
    return metrics.mean_per_run(one.error, one.scored)


def largest(one: Runs) -> Floats:
    """[R]: mean over UAVs of the largest error, m."""
    return np.where(one.scored, one.error, 0.0).max(1).mean(1)


def rmse_of_all(one: Runs) -> float:
    """Over all runs, m."""
    return metrics.rmse(one.error, one.scored)


def per_step(one: Runs) -> Floats:
    """[K]: RMSE over runs and UAVs, m."""
    return metrics.rmse_per_step(one.error, one.scored)


def quantile(share: float) -> Callable[[Runs], float]:
    """Of all errors scored, m."""

    def of(one: Runs) -> float:
        errors = one.error[one.scored]
        return float(np.quantile(errors, share)) if errors.size else float("nan")

    return of


def rmse_of_bound(bound: Bound) -> float:
    """RMSE (m) that a bound allows; a snapshot's of the UAVs that one step localizes."""
    return bound.rmse_localizable if isinstance(bound, SnapshotBound) else bound.rmse
