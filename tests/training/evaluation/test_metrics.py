"""Figures of merit against hand-computed numbers, brute force and scipy."""

import itertools

import numpy as np
import pytest
from scipy import stats

from training.evaluation import metrics

ERROR = np.array([[[1.0, 2.0], [3.0, 4.0]], [[5.0, 6.0], [7.0, 100.0]]], np.float32)  # [R, K, N]
SCORED = np.array([[[True, True], [True, True]], [[True, True], [True, False]]])


def test_root_mean_squares_by_hand() -> None:
    assert metrics.rmse(ERROR, SCORED) == pytest.approx(np.sqrt(140 / 7))
    np.testing.assert_allclose(
        metrics.rmse_per_run(ERROR, SCORED), [np.sqrt(30 / 4), np.sqrt(110 / 3)]
    )
    np.testing.assert_allclose(
        metrics.rmse_per_uav(ERROR, SCORED), [np.sqrt(84 / 4), np.sqrt(56 / 3)]
    )
    np.testing.assert_allclose(
        metrics.rmse_per_step(ERROR, SCORED), [np.sqrt(66 / 4), np.sqrt(74 / 3)]
    )
    np.testing.assert_allclose(metrics.rmse_per_track(ERROR, SCORED), np.sqrt([[5, 10], [37, 36]]))
    assert metrics.ate(ERROR, SCORED) == pytest.approx(np.sqrt([5, 10, 37, 36]).mean())
    assert metrics.largest(ERROR, SCORED) == pytest.approx((3 + 4 + 7 + 6) / 4)


def test_what_is_after_some_seconds() -> None:
    error = np.arange(40.0).reshape(1, 40, 1)
    scored = np.ones_like(error, bool)
    late = np.arange(30, 40) ** 2
    assert metrics.rmse_after(error, scored, 0.1, 3.0) == pytest.approx(np.sqrt(late.mean()))
    assert np.isnan(metrics.rmse_after(error, scored, 0.1, 4.0))


def test_nothing_scored_is_nan_without_warnings(recwarn: pytest.WarningsRecorder) -> None:
    none, offset = np.zeros_like(SCORED), np.zeros((*SCORED.shape, 3))
    assert np.isnan(metrics.rmse(ERROR, none))
    assert np.isnan(metrics.rmse_per_uav(ERROR, none)).all()
    assert np.isnan(metrics.largest(ERROR, none))
    assert np.isnan(metrics.relative_error(offset, none))
    assert np.isnan(metrics.formation_error(offset, offset, none))
    assert not metrics.lost(ERROR, none, 1.0, 3.0).any()
    assert not recwarn.list


def test_errors_between_uavs_against_brute_force() -> None:
    rng = np.random.default_rng(0)
    truth, offset = rng.normal(size=(2, 3, 4, 5, 3))
    scored = rng.uniform(size=(3, 4, 5)) < 0.7
    relative, distances = [], []
    for r, k in itertools.product(range(3), range(4)):
        for i, j in itertools.combinations(np.flatnonzero(scored[r, k]), 2):
            p, e = truth[r, k], offset[r, k]
            relative.append(np.sum((e[j] - e[i]) ** 2))
            apart = np.linalg.norm(p[j] + e[j] - p[i] - e[i]) - np.linalg.norm(p[j] - p[i])
            distances.append(apart**2)
    assert metrics.relative_error(offset, scored) == pytest.approx(np.sqrt(np.mean(relative)))
    found = metrics.formation_error(truth, offset, scored)
    assert found == pytest.approx(np.sqrt(np.mean(distances)))


def test_relative_pose_error_by_hand() -> None:
    offset = np.zeros((1, 4, 1, 2))
    offset[0, :, 0, 0] = (0.0, 1.0, 3.0, 6.0)
    scored = np.ones((1, 4, 1), bool)
    assert metrics.rpe(offset, scored, 2) == pytest.approx(np.sqrt((9 + 25) / 2))
    scored[0, 0] = False
    assert metrics.rpe(offset, scored, 2) == pytest.approx(5.0)
    assert np.isnan(metrics.rpe(offset, scored, 4))


def test_who_is_lost() -> None:
    steps, dt = 20, 1.0
    error = np.zeros((1, steps, 6))
    scored = np.ones((1, steps, 6), bool)
    error[0, :15, 0] = 9.0  # found its way
    error[0, 15:, 1] = 9.0  # lost for the last 5 s
    error[0, 15:, 2] = 9.0
    error[0, 17, 2] = 0.0  # good once in them
    error[0, 5:10, 3] = 9.0
    scored[0, 10:, 3] = False  # failed while lost
    scored[0, :, 4] = False  # never scored
    error[0, :, 5], scored[0, 2:, 5] = 9.0, False  # lost all its two steps
    assert metrics.lost(error, scored, dt, 3.0).tolist() == [
        [False, True, False, True, False, True]
    ]
    assert not metrics.lost(error, scored, dt, 9.0).any()


def test_nees_band() -> None:
    low, high = metrics.nees_band(3, 120)
    assert stats.chi2.cdf(low * 120, 360) == pytest.approx(0.025)
    assert stats.chi2.cdf(high * 120, 360) == pytest.approx(0.975)


def test_paired_difference_against_scipy() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 20))
    interval = stats.ttest_rel(a, b).confidence_interval(0.95)
    found = metrics.paired_difference(a, b)
    np.testing.assert_allclose((found.low, found.high), (interval.low, interval.high))
    assert found.mean == pytest.approx((a - b).mean())
    a[3] = np.nan
    assert np.isfinite(metrics.paired_difference(a, b).high)
    assert metrics.paired_difference(a[:1], b[:1]).high == np.inf
