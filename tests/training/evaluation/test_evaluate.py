"""Evaluation: the schema, pairing, repeatability, and what goes wrong is counted."""

import copy
import dataclasses
import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from agents import Estimate, make
from coloc_env.bounds import posterior_bound
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from training.evaluation import metrics
from training.evaluation.evaluate import evaluate
from training.evaluation.results import Evaluation
from training.evaluation.rollout import rollout

FIGURES = [
    "rmse",
    "rmse_std",
    "mean",
    "median",
    "max",
    "per_uav_rmse",
    "rmse_after_10s",
    "diverged_runs",
    "nees",
    "avg_particles",
    "bytes_per_step",
    "ms_per_step",
    "ratio_to_bound",
    "diagnostics",
]
AGENTS = ["dead_reckoning", "test_still", "test_still:offset=0.1:std=1"]


def scenario(**overrides: object) -> Scenario:
    return make_scenario("indoor-v0", **{"n_uavs": 3, "horizon": 120} | overrides)


def timeless(results: Evaluation) -> dict[str, Any]:
    """The summary without its times."""
    summary = copy.deepcopy(results.summary)
    for figures in summary["agents"].values():
        assert figures.pop("ms_per_step") > 0
    return summary


@pytest.fixture(scope="module")
def results(localizers: None) -> Evaluation:
    return evaluate(scenario(), AGENTS, runs=4, seed=10)


def test_schema(results: Evaluation) -> None:
    summary = json.loads(json.dumps(results.summary, allow_nan=False))
    assert list(summary) == ["scenario", "overrides", "seed", "runs", "steps", "bound", "agents"]
    assert (summary["scenario"], summary["seed"], summary["runs"]) == ("indoor-v0", 10, 4)
    assert (summary["steps"], list(summary["agents"])) == (120, AGENTS)
    assert list(summary["bound"]) == ["rmse"]
    for figures in summary["agents"].values():
        assert list(figures) == FIGURES
        assert len(figures["per_uav_rmse"]) == 3
        for value in (*figures["diagnostics"].values(), *figures["per_uav_rmse"]):
            assert isinstance(value, int | float)
        for key in set(FIGURES) - {
            "diagnostics",
            "per_uav_rmse",
            "avg_particles",
            "bytes_per_step",
        }:
            assert isinstance(figures[key], int | float), key
        assert isinstance(figures["diverged_runs"], int)


def test_figures_by_numpy(results: Evaluation) -> None:
    for name, figures in results.summary["agents"].items():
        error = results.agents[name].error.astype(np.float64)
        squares = error**2
        assert error.shape == (4, 120, 3)
        assert figures["rmse"] == pytest.approx(np.sqrt(squares.mean()))
        per_run = np.sqrt(squares.mean((1, 2)))
        assert figures["rmse_std"] == pytest.approx(per_run.std(ddof=1))
        assert figures["mean"] == pytest.approx(error.mean())
        assert figures["median"] == pytest.approx(np.median(error))
        assert figures["max"] == pytest.approx(error.max(1).mean())
        assert figures["per_uav_rmse"] == pytest.approx(np.sqrt(squares.mean((0, 1))).tolist())
        assert figures["rmse_after_10s"] == pytest.approx(np.sqrt(squares[:, 100:].mean()))
        assert figures["ratio_to_bound"] == pytest.approx(
            figures["rmse"] / results.summary["bound"]["rmse"]
        )
        own = figures["diagnostics"]
        assert own["p90"] == pytest.approx(np.percentile(error, 90))
        assert own["ate"] == pytest.approx(np.sqrt(squares.mean(1)).mean())
        assert (own["nees_low"], own["nees_high"]) == pytest.approx(metrics.nees_band(3, 12))
    still = results.summary["agents"]["test_still"]
    assert still["nees"] == pytest.approx(still["rmse"] ** 2 / 4, rel=1e-5)
    assert still["avg_particles"] == pytest.approx(100 + np.arange(120).mean())
    assert still["diagnostics"]["calm"] == 1
    assert results.summary["agents"]["dead_reckoning"]["avg_particles"] is None


def test_bound_is_of_the_same_worlds(results: Evaluation) -> None:
    known = posterior_bound(scenario(), runs=4, seed=10)
    assert results.summary["bound"]["rmse"] == pytest.approx(known.rmse)


def test_worlds_are_paired(results: Evaluation) -> None:
    alone = evaluate(scenario(), AGENTS[1:2], runs=2, seed=11, bound=False)
    np.testing.assert_array_equal(alone.worlds.truth, results.worlds.truth[1:3])
    np.testing.assert_array_equal(
        alone.agents["test_still"].error, results.agents["test_still"].error[1:3]
    )
    assert alone.summary["bound"] == {"rmse": None}
    assert alone.summary["agents"]["test_still"]["ratio_to_bound"] is None


def test_same_seed_same_results_in_any_chunks(results: Evaluation) -> None:
    assert timeless(evaluate(scenario(), AGENTS, runs=4, seed=10)) == timeless(results)
    assert timeless(evaluate(scenario(), AGENTS, runs=4, seed=10, chunk=3)) == timeless(results)


def test_paired_difference(results: Evaluation) -> None:
    a, b = (
        np.sqrt((results.agents[name].error.astype(np.float64) ** 2).mean((1, 2)))
        for name in AGENTS[1:]
    )
    found = results.paired_difference(*AGENTS[1:])
    assert found.mean == pytest.approx((a - b).mean())
    assert found.low < found.mean < found.high


def test_diverged_runs_are_counted_and_kept() -> None:
    room = {"horizon": 60, "prior_std": 0.01, "motion": "stop_and_go"}
    names = [
        "test_still",
        "test_still:offset=1",
        "test_still:wrong=nan:at=59",
        "test_still:wrong=raises:at=59",
    ]
    results = evaluate(scenario(**room), names, runs=3, bound=False)
    assert results.lost_beyond == pytest.approx(3.0)
    figures = results.summary["agents"]
    lost = [(results.agents[name].error[:, 10:].min(1) > 3).any() for name in names]
    assert lost == [False, True, False, False]
    assert [figures[name]["diverged_runs"] for name in names] == [0, 3, 3, 3]
    assert figures[names[3]]["diagnostics"]["raised_runs"] == 3
    assert results.agents[names[3]].messages[0] == "step 59: RuntimeError: the matrix is singular"
    for name in names:
        assert results.agents[name].error.shape == (3, 60, 3)
        assert math.isfinite(figures[name]["rmse"])
    assert figures[names[2]]["ms_per_step"] > 0
    assert figures[names[3]]["ms_per_step"] > 0  # it raises after the steps that are timed


def test_figures_that_do_not_apply_are_null() -> None:
    task = scenario(horizon=5, n_uavs=1, comm_radius=5.0)
    figures = evaluate(task, ["test_still:wrong=raises"], runs=1, bound=False).summary["agents"]
    (only,) = figures.values()
    for key in ("rmse_std", "rmse_after_10s", "nees", "avg_particles", "ms_per_step"):
        assert only[key] is None
    assert only["diverged_runs"] == 1
    assert only["diagnostics"]["nees_undefined_share"] == 1
    assert only["diagnostics"]["nrmse"] == pytest.approx(only["rmse"] / 5)
    assert not {"fge", "relative_error"} & only["diagnostics"].keys()


def test_errors_are_measured_from_the_reference_too() -> None:
    """A UAV that estimates just what its reference shows has no error from it; the truth has."""
    task = make_scenario("campus-v0", n_uavs=4, anchor_share=0.0, horizon=8, gps_cep=2.0)
    results = evaluate(task, ["dead_reckoning"], runs=2, seed=5, bound=False)
    (agent,) = results.agents.values()
    assert results.reference is not None
    assert task.reference is not None
    again = task.reference.errors(torch.tensor([6]), 8, 4, 3, 0.1)
    np.testing.assert_array_equal(results.reference[1:], again)
    reported = {}
    for name, offset in (("reference", results.reference), ("truth", np.zeros_like(agent.offset))):
        posing = dataclasses.replace(agent, offset=offset)
        changed = dataclasses.replace(results, agents={name: posing})
        reported[name] = changed.summary["agents"][name]["diagnostics"]
    assert reported["reference"]["ate_reference"] == pytest.approx(0.0)
    assert reported["reference"]["fge_reference"] == pytest.approx(0.0)
    assert reported["truth"]["fge"] == pytest.approx(0.0)
    apart = np.linalg.norm(results.reference, axis=-1)
    assert reported["truth"]["ate_reference"] == pytest.approx(np.sqrt((apart**2).mean(1)).mean())
    assert reported["truth"]["fge_reference"] == pytest.approx(reported["reference"]["fge"])
    assert reported["truth"]["fge_reference"] > 0.5


def test_unscored_steps_do_not_count() -> None:
    task = scenario(horizon=20)
    object.__setattr__(task, "failures", ((0, 1), (1, 8)))
    results = evaluate(task, ["test_still"], runs=2, bound=False)
    figures, error = results.summary["agents"]["test_still"], results.agents["test_still"].error
    kept = [error[:, 0, 0], error[:, :8, 1], error[:, :, 2]]
    assert figures["mean"] == pytest.approx(np.concatenate([x.ravel() for x in kept]).mean())
    assert figures["diagnostics"]["calm"] == 1
    assert figures["diagnostics"]["steps_per_run"] == pytest.approx((1 + 8 + 20) / 3)


def test_threads_are_given_back() -> None:
    torch.set_num_threads(2)
    evaluate(scenario(horizon=3), ["test_still"], runs=1, bound=False)
    assert torch.get_num_threads() == 2


def test_progress() -> None:
    reported: list[tuple[str, int, int]] = []
    evaluate(
        scenario(horizon=5), ["test_still"], runs=3, progress=lambda *x: reported.append(x), chunk=2
    )
    assert reported[0] == ("bound", 0, 1)
    done = [done for what, done, _ in reported if what == "test_still"]
    assert done == [*range(2, 11, 2), *range(11, 16)]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"agents": []}, "at least one"),
        ({"agents": ["ekf", "ekf"]}, "'ekf' is named twice"),
        ({"agents": ["ekff"]}, "did you mean 'ekf'"),
        ({"agents": ["ekf:robust=maybe"]}, "robust='maybe' is not allowed"),
        ({"runs": 0}, "runs=0"),
        ({"runs": 10**11}, "runs=100000000000 is not allowed: 1 to 10000000"),
        ({"seed": -1}, "seed=-1"),
        ({"chunk": 0}, "chunk=0"),
    ],
)
def test_clear_words(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        evaluate(scenario(), **{"agents": ["test_still"], "runs": 1} | wrong)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda one: one.position, "step must return a belief and an Estimate, not Tensor"),
        (
            lambda one: one.replace(position=one.position[..., :2]),
            r"an estimate's position must be \[2, 3, 3\], not \[2, 3, 2\]",
        ),
        (
            lambda one: one.replace(covariance=one.covariance.diagonal(dim1=-2, dim2=-1)),
            r"an estimate's covariance must be \[2, 3, 3, 3\], not \[2, 3, 3\]",
        ),
    ],
)
def test_estimates_of_a_wrong_shape_are_named(
    spoil: Callable[[Estimate], Any], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    localizer = make("test_still", scenario())
    right = localizer.step
    monkeypatch.setattr(
        localizer, "step", lambda *given: (right(*given)[0], spoil(right(*given)[1]))
    )
    with pytest.raises(ValueError, match=words):
        next(rollout(localizer, scenario(), torch.arange(2)))
