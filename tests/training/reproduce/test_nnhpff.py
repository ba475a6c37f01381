"""``coloc reproduce nnhpff``: the detector against scikit-learn, verdicts on made-up runs."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made import Made, runs_of
from sklearn import calibration as oracle
from sklearn import metrics

from agents import make
from coloc_env.scenarios import make_scenario
from training.reproduce.measures import mean_error
from training.reproduce.nnhpff import bias, detection, nnhpff, noise, plan
from training.reproduce.nnhpff.claims import claims
from training.reproduce.nnhpff.plan import (
    HELD,
    corner_peak,
    first_reset,
    recovery,
    resets_per_run,
    settled_error,
)
from training.reproduce.results import Runs
from training.reproduce.settings import Settings
from training.reproduce.study import reproduce
from training.reproduce.verdicts import (
    CONTRADICTED,
    NOT,
    REPRODUCED,
    UNKNOWN,
    Difference,
    Verdict,
    away_from_zero,
    judge,
)
from training.reproduce.work import Piece

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
    np.testing.assert_allclose(found.probability[full], said)
    assert found.brier == pytest.approx(metrics.brier_score_loss(failed, score))
    weighted = (np.abs(said - share) * found.count[full]).sum() / found.count.sum()
    assert found.error == pytest.approx(weighted)


@pytest.mark.parametrize("ties", [False, True])
def test_no_threshold_is_less_wrong(ties: bool) -> None:
    score, failed = samples(ties)
    found = detection.confusion(score, failed, detection.least_wrong(score, failed)).accuracy
    every = np.concatenate(([-1.0], np.unique(score)))
    assert found == max(detection.confusion(score, failed, x).accuracy for x in every)


def test_all_of_one_kind_have_a_threshold_beyond_them() -> None:
    score = np.array([0.1, 0.4])
    assert detection.least_wrong(score, np.array([False, False])) >= 0.4
    assert detection.least_wrong(score, np.array([True, True])) < 0.1


# ---------------------------------------------------------------- runs


def runs(error: np.ndarray, resets: np.ndarray | None = None) -> Runs:
    """An agent's runs with these errors [R, K] (m) and resets."""
    series = {} if resets is None else {"resets_per_run": resets[..., None]}
    scenario = make_scenario("wsn-v0", horizon=error.shape[1])
    return runs_of(scenario, error[..., None], series=series, nees=2.0)


def test_figures_of_a_run() -> None:
    error, resets = np.full((2, STEPS), 0.1), np.zeros((2, STEPS))
    error[:, :20], error[0, 120], error[1, 230] = 1.1, 0.9, 5.0
    resets[0, [3, 130, 140]] = 1
    one = runs(error, resets)
    assert mean_error(one) == pytest.approx(error.mean(1), abs=1e-6)
    assert settled_error(one) == pytest.approx(error[:, 20:].mean(1), abs=1e-6)
    assert resets_per_run(one).tolist() == [3.0, 0.0]
    assert corner_peak(one) == pytest.approx([0.9, 0.1])
    assert first_reset(one).tolist() == [130.0, np.inf]


def test_recovery_counts_once_the_error_stays_small() -> None:
    error = np.full((3, STEPS), 2.0)
    error[0, 187:] = 0.1  # 7 steps after
    error[1, 183:185], error[1, 200:] = 0.1, 0.1  # small for a moment only, then at last
    time = recovery(runs(error), 180, slice(0, 1))[:, 0]
    assert time == pytest.approx([0.7, 2.0, np.inf])
    assert HELD == 10


def test_runs_that_end_before_the_corner_have_no_peak() -> None:
    short = runs(np.full((2, 50), 0.1), np.ones((2, 50)))
    assert np.isnan(corner_peak(short)).all()
    assert np.isinf(first_reset(short)).all()


# ---------------------------------------------------------------- verdicts


def key(number: int, agent: str) -> tuple[str, str]:
    return plan.case(number).key, agent


def cases(better: bool) -> dict[tuple[str, str], Runs]:
    """Runs as the paper describes them, or the other way round."""
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
        key(1, "pf"): runs(world),
        key(1, "hpff:bank=false"): runs(1.01 * world, late),
        key(1, "nnhpff:bank=false"): runs(world, none),
        key(2, "pf"): runs(world),
        key(2, "hpff:bank=false"): runs(
            (1.5 if better else 0.5) * world, often if better else none
        ),
        key(2, "nnhpff:bank=false"): runs(
            (1.01 if better else 1.5) * world, none if better else often
        ),
        key(3, "pf"): runs(world + (1.0 if better else 0.1) * corner),
        key(3, "hpff:bank=false"): runs(world + (0.71 if better else 1.5) * corner, late),
        key(3, "nnhpff:bank=false"): runs(world + (0.7 if better else 1.7) * corner, early),
    }


def judged(found: dict[tuple[str, str], Runs]) -> list[Verdict]:
    return judge(claims(Settings(Path("x"), RUNS)), Made(found))


def test_the_papers_own_figures_bear_out_its_claims() -> None:
    assert {each.verdict for each in judged(cases(True))} == {REPRODUCED}


def test_the_opposite_contradicts_them() -> None:
    words = {each.claim.words: each.verdict for each in judged(cases(False))}
    of_two_and_three = {w: v for w, v in words.items() if not w.startswith("case 1")}
    assert set(of_two_and_three.values()) <= {CONTRADICTED, NOT}
    assert list(of_two_and_three.values()).count(CONTRADICTED) >= 8


def test_what_was_not_run_is_not_judged() -> None:
    some = {k: one for k, one in cases(True).items() if k[1] != "nnhpff:bank=false"}
    for each in judged(some):
        assert (each.verdict == UNKNOWN) == ("NN-HPFF" in each.claim.words)


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(-2.0, 3.0, (0.0, 3.0)), (1.0, 3.0, (1.0, 3.0)), (-3.0, -1.0, (1.0, 3.0))],
)
def test_the_size_of_a_difference(low: float, high: float, expected: tuple[float, float]) -> None:
    found = away_from_zero(Difference(0.5 * (low + high), low, high))
    assert (found.low, found.high) == expected


# ---------------------------------------------------------------- the plan, and all of it at once


def test_every_scenario_of_the_plan_can_be_built(tmp_path: Path) -> None:
    settings = Settings(tmp_path, 1)
    for cell in (*plan.paper(settings), *plan.detector(settings), *plan.beyond(settings)):
        if not cell.variant.scenario.startswith("replay"):
            for agent in cell.agents:
                make(agent, cell.variant.build())
    assert len(plan.trained_on()) == 27


@pytest.mark.slow
def test_a_small_page(tmp_path: Path) -> None:
    variants = ["case1", "case1-kidnap_at=18", "trained-q=1-believed_uwb_std=0.6"]
    agents = [
        "pf",
        "hpff:bank=false",
        "nnhpff:bank=false",
        "nnhpff:bank=false:main=pf@particles=500:threshold=1",
        plan.RESIDUALS,
    ]
    chosen: dict[str, Any] = {"agents": agents, "variants": variants, "steps": 25}
    reproduce(nnhpff(), Settings(tmp_path, 2, **chosen))
    text = (tmp_path / "page.md").read_text()
    assert "14 claims" in text
    assert "| case 1: noise known" in text
    for name in ("network", "Σr² alone", "d alone"):
        assert f"| the 27 scenarios, other worlds | {name} | 25 |" in text
    for name in ("figure_5_case_1.png", "figure_8_ale.png"):
        assert (tmp_path / name).exists()
    stored = sorted(file.stat().st_mtime for file in (tmp_path / "store").rglob("*.npz"))
    reproduce(nnhpff(), Settings(tmp_path, 2, report_only=True, **chosen))
    assert (tmp_path / "page.md").read_text() == text
    assert stored == sorted(file.stat().st_mtime for file in (tmp_path / "store").rglob("*.npz"))


def test_detectors_over_several_noises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where only residuals tell, the network learns what a threshold on their sum has."""
    rng = np.random.default_rng(0)

    def made(std: float) -> noise.Samples:
        error = rng.choice([0.1, 1.0], (4, 300))
        residuals = np.abs(rng.normal(0, std, (4, 300, 4)) + 0.6 * (error > 0.5)[..., None])
        rms, d = np.sqrt(np.mean(residuals**2, -1)), rng.random((4, 300))
        features = np.concatenate((np.log1p(d)[..., None], residuals), -1)
        return noise.Samples(*(x.astype(np.float32) for x in (features, d, rms, error)))

    there = {std: made(std) for std in noise.JUDGED}
    monkeypatch.setattr(noise, "_samples", lambda _, std: there[std])
    (table,) = noise.tables(None)  # type: ignore[arg-type]
    areas = {(row[0], row[1]): [float(x) for x in row[2:6]] for row in table.rows}
    assert len(areas) == 6
    for fitted in ("0.2", "0.1, 0.2, 0.4"):
        assert min(areas[fitted, "network"][:2]) > 0.97
        assert max(areas[fitted, "d"]) < 0.6
    assert areas["0.2", "√(Σr²/n)"] == areas["0.1, 0.2, 0.4", "√(Σr²/n)"]  # a score, unfitted


def test_what_detectors_see_is_recorded() -> None:
    where = noise.variants(0.2, steps=5)[0]
    arrays, _ = noise.compute(Piece(where, (noise.MAIN,), 0, 2, noise.SAMPLES), lambda *_: None)
    found = noise.load(where, arrays, {})
    assert found.features.shape == (2, 5, 5)
    squared = (found.features[..., 1:] ** 2).mean(-1)
    np.testing.assert_allclose(found.rms**2, squared, rtol=1e-4)


def test_areas_apart_by_worlds() -> None:
    """A score that knows more than one that guesses, and two that order alike."""
    rng = np.random.default_rng(0)
    failed = rng.random((10, 80)) < 0.3
    knows, guesses = failed + rng.normal(0, 0.5, failed.shape), rng.random(failed.shape)
    found = bias.areas_apart(knows, guesses, failed)
    areas = [metrics.roc_auc_score(failed.ravel(), x.ravel()) for x in (knows, guesses)]
    assert found.mean == pytest.approx(areas[0] - areas[1])
    assert 0.2 < found.low < found.mean < found.high < 0.6
    same = bias.areas_apart(knows, 3 * knows + 1, failed)
    assert (same.mean, same.low, same.high) == (0.0, 0.0, 0.0)


@pytest.mark.slow
def test_what_is_biased_is_run_and_told_apart(tmp_path: Path) -> None:
    where = bias.variants()[1].key
    reproduce(nnhpff(), Settings(tmp_path, 2, variants=[where], steps=15, part="bias"))
    text = (tmp_path / "page.md").read_text()
    assert text.count("| case=3, biased_anchors=2, anchor_bias=1 |") == 2


def test_figure_4_is_trained_with_the_whole_study_only(tmp_path: Path) -> None:
    assert [t.key for t in plan.trainings(Settings(tmp_path, 1))] == ["nnhpff"]
    assert not list(plan.trainings(Settings(tmp_path, 1, steps=9)))
    assert not list(plan.trainings(Settings(tmp_path, 1, variants=["case1"])))
