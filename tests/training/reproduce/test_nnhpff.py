"""``coloc reproduce nnhpff``: figures of merit against scikit-learn, verdicts on made-up runs."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sklearn import calibration as oracle
from sklearn import metrics

from agents import make
from coloc_env.scenarios import make_scenario
from training.evaluation.record import RunRecord
from training.evaluation.results import Evaluation
from training.reproduce.nnhpff import detection, plan
from training.reproduce.nnhpff.claims import verdicts
from training.reproduce.nnhpff.measures import HELD, Runs
from training.reproduce.nnhpff.run import NAMES, reproduce
from training.reproduce.verdicts import (
    CONTRADICTED,
    NOT,
    REPRODUCED,
    UNKNOWN,
    Difference,
    away_from_zero,
)

RUNS, STEPS = 12, 360


def samples(ties: bool) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities (with many that are equal), and what happened."""
    rng = np.random.default_rng(1)
    failed = rng.random(500) < 0.3
    score = np.clip(rng.normal(0.3 + 0.3 * failed, 0.2), 0, 1)
    return np.round(score, 1) if ties else score, failed


# ---------------------------------------------------------------- the detector's figures


@pytest.mark.parametrize("ties", [False, True])
def test_areas_are_scikit_learns(ties: bool) -> None:
    score, failed = samples(ties)
    found = detection.curve(score, failed)
    assert found.auc == pytest.approx(metrics.roc_auc_score(failed, score))
    expected = metrics.average_precision_score(failed, score)
    assert found.average_precision == pytest.approx(expected)


def test_the_roc_curve_is_scikit_learns() -> None:
    score, failed = samples(True)
    found = detection.curve(score, failed)
    false_alarms, hits, _ = metrics.roc_curve(failed, score, drop_intermediate=False)
    np.testing.assert_allclose(found.false_alarms, false_alarms)
    np.testing.assert_allclose(found.hits, hits)


def test_a_curve_needs_both_kinds() -> None:
    with pytest.raises(ValueError, match="samples that failed and samples that did not"):
        detection.curve(np.array([0.1, 0.2]), np.array([True, True]))


def test_confusion_is_scikit_learns() -> None:
    score, failed = samples(False)
    found = detection.confusion(score, failed, 0.5)
    (sound, alarms), (missed, hit) = metrics.confusion_matrix(failed, score > 0.5)
    assert (found.correct_rejections, found.false_alarms) == (sound, alarms)
    assert (found.misses, found.hits) == (missed, hit)
    assert found.precision == pytest.approx(metrics.precision_score(failed, score > 0.5))
    assert found.recall == pytest.approx(metrics.recall_score(failed, score > 0.5))
    assert found.accuracy == pytest.approx(metrics.accuracy_score(failed, score > 0.5))
    assert found.false_alarm_rate == pytest.approx(alarms / (alarms + sound))


def test_calibration_is_scikit_learns() -> None:
    score, failed = samples(False)
    found = detection.calibration(score, failed)
    share, said = oracle.calibration_curve(failed, score, n_bins=detection.BINS)
    full = found.count > 0
    np.testing.assert_allclose(found.failed[full], share)
    np.testing.assert_allclose(found.said[full], said)
    assert found.brier == pytest.approx(metrics.brier_score_loss(failed, score))
    weighted = (np.abs(said - share) * found.count[full]).sum() / found.count.sum()
    assert found.error == pytest.approx(weighted)


# ---------------------------------------------------------------- runs


def flown(error: np.ndarray, resets: np.ndarray | None = None) -> Runs:
    """An agent's runs with these errors [R, K] (m) and resets."""
    error = error[..., None].astype(np.float32)
    series = {} if resets is None else {"resets_per_run": resets[..., None].astype(np.float32)}
    one = RunRecord(
        offset=np.stack((error, 0 * error), -1),
        error=error,
        nees=np.full(error.shape, 2.0, np.float32),
        broken=np.zeros(len(error), bool),
        series=series,
        ms_per_step=None,
    )
    scored = np.ones(error.shape, bool)
    scenario = make_scenario("wsn-v0", horizon=error.shape[1])
    truth = np.zeros((*error.shape, 2))
    return Runs(Evaluation(scenario, 0, truth, truth[0, :, :, :1], scored, None, {"x": one}), "x")


def test_figures_of_a_run() -> None:
    error, resets = np.full((2, STEPS), 0.1), np.zeros((2, STEPS))
    error[:, :20], error[0, 120], error[1, 230] = 1.1, 0.9, 5.0
    resets[0, [3, 130, 140]] = 1
    one = flown(error, resets)
    assert one.ale() == pytest.approx(error.mean(1), abs=1e-6)
    assert one.settled_ale() == pytest.approx(error[:, 20:].mean(1), abs=1e-6)
    assert one.resets_per_run().tolist() == [3.0, 0.0]
    assert one.corner_peak() == pytest.approx([0.9, 0.1])
    assert one.first_reset().tolist() == [130.0, np.inf]


def test_recovery_counts_once_the_error_stays_small() -> None:
    error = np.full((3, STEPS), 2.0)
    error[0, 187:] = 0.1  # 7 steps after
    error[1, 183:185], error[1, 200:] = 0.1, 0.1  # small for a moment only, then at last
    time = flown(error).recovery(180, slice(0, 1))[:, 0]
    assert time == pytest.approx([0.7, 2.0, np.inf])
    assert HELD == 10


def test_runs_that_end_before_the_corner_have_no_peak() -> None:
    short = flown(np.full((2, 50), 0.1), np.ones((2, 50)))
    assert np.isnan(short.corner_peak()).all()
    assert np.isinf(short.first_reset()).all()


# ---------------------------------------------------------------- verdicts


def cases(better: bool) -> dict[tuple[int, str], Runs]:
    """Runs as the paper tells of them, or the other way round."""
    rng = np.random.default_rng(0)
    world = 0.1 * (1 + 0.05 * rng.random((RUNS, STEPS)))
    none, often = np.zeros((RUNS, STEPS)), np.ones((RUNS, STEPS))
    late, early = none.copy(), none.copy()
    late[:, 150], early[:, 110] = 1, 1
    corner = np.zeros(STEPS)
    corner[100:200] = 1.0
    if not better:
        early, late = late, early
    return {
        (1, "pf"): flown(world),
        (1, "hpff"): flown(1.01 * world, late),
        (1, "nnhpff"): flown(world, none),
        (2, "pf"): flown(world),
        (2, "hpff"): flown((1.5 if better else 0.5) * world, often if better else none),
        (2, "nnhpff"): flown((1.01 if better else 1.5) * world, none if better else often),
        (3, "pf"): flown(world + (1.0 if better else 0.1) * corner),
        (3, "hpff"): flown(world + (0.71 if better else 1.5) * corner, late),
        (3, "nnhpff"): flown(world + (0.7 if better else 1.7) * corner, early),
    }


def test_the_papers_own_figures_bear_out_its_claims() -> None:
    assert {each.verdict for each in verdicts(cases(True))} == {REPRODUCED}


def test_the_opposite_contradicts_them() -> None:
    judged = {each.claim.words: each.verdict for each in verdicts(cases(False))}
    of_two_and_three = {w: v for w, v in judged.items() if not w.startswith("case 1")}
    assert set(of_two_and_three.values()) <= {CONTRADICTED, NOT}
    assert list(of_two_and_three.values()).count(CONTRADICTED) >= 8


def test_what_was_not_flown_is_not_judged() -> None:
    some = {key: one for key, one in cases(True).items() if key[1] != "nnhpff"}
    for each in verdicts(some):
        assert (each.verdict == UNKNOWN) == ("NN-HPFF" in each.claim.words)


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(-2.0, 3.0, (0.0, 3.0)), (1.0, 3.0, (1.0, 3.0)), (-3.0, -1.0, (1.0, 3.0))],
)
def test_the_size_of_a_difference(low: float, high: float, expected: tuple[float, float]) -> None:
    found = away_from_zero(Difference(0.5 * (low + high), low, high))
    assert (found.low, found.high) == expected


# ---------------------------------------------------------------- the plan, and all of it at once


def test_every_scenario_of_the_plan_can_be_built() -> None:
    simulated = (*plan.sensitivity(None), *plan.kidnapping(None), *plan.blocked(None))
    for variant, agents in simulated:
        for agent in agents:
            make(agent, variant.build())
    for variant, agent in (*plan.trained_on(None), *plan.never_seen(None)):
        make(agent, variant.build())
    assert len(plan.trained_on(None)) == 27


def quiet(*_: Any) -> None:
    """Tells nobody."""


def test_a_small_report(tmp_path: Path) -> None:
    where = ["case1", "case1-kidnap_at=18", "trained-q=1-believed_uwb_std=0.6"]
    small: dict[str, Any] = {"runs": 2, "seed": 0, "where": where, "steps": 25, "jobs": 1}
    reproduce(tmp_path, "all", missing=True, tell=quiet, note=quiet, **small)
    text = (tmp_path / "report.md").read_text()
    assert "14 claims" in text
    assert "| case 1: noise known" in text
    assert "the 27 scenarios, other worlds" in text
    for name in ("figure_5_case_1.png", "figure_8_ale.png", "paper.json"):
        assert (tmp_path / name).exists()
        assert name in NAMES
    stored = sorted(file.stat().st_mtime for file in (tmp_path / "store").rglob("*.npz"))
    reproduce(tmp_path, "all", missing=False, tell=quiet, note=quiet, **small)
    assert (tmp_path / "report.md").read_text() == text
    assert stored == sorted(file.stat().st_mtime for file in (tmp_path / "store").rglob("*.npz"))


def test_unknown_variants_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown variant 'case9'"):
        reproduce(tmp_path, "paper", 2, 0, ["case9"], 20, 1, True, quiet, quiet)
