"""``coloc reproduce cspf``: measures and verdicts on made-up runs, and a small page."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from made import Made, runs_of

from coloc_env.datasets import DataError
from coloc_env.scenarios import make_scenario
from training.evaluation.evaluate import evaluate
from training.reproduce.cspf import clouds, cspf, particle_errors, plan
from training.reproduce.cspf.claims import claims, real
from training.reproduce.cspf.plan import converged, converged_over_time, late_nees, worst
from training.reproduce.results import Runs
from training.reproduce.settings import Settings
from training.reproduce.study import reproduce
from training.reproduce.verdicts import CONTRADICTED, NOT, REPRODUCED, UNKNOWN, judge
from training.reproduce.work import WORLD, Piece

RUNS = 100


def made_up(share: float, size: float, steps: int = plan.LATE) -> Runs:
    """The first ``share`` of 100 runs converges at step 100, its worst error ``size`` m."""
    close = np.zeros((RUNS, steps, 3))
    close[: round(share * RUNS), 100:] = 1
    error = np.full((RUNS, steps, 3), 0.5 * size)
    error[:, :, 1] = size
    series = {"converged": close, "team_error": error}
    return runs_of(make_scenario("stein2d-v0", horizon=steps), error, series=series, nees=2.0)


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(tmp_path, RUNS)


def test_measures() -> None:
    runs = made_up(0.4, 0.2)
    assert not converged(runs, 100).any()
    assert converged(runs, 101).sum() == 40
    runs.record.broken[:10] = True
    assert converged(runs, 150).sum() == 30
    assert converged_over_time(runs)[[99, 100]].tolist() == [0.0, 0.3]
    runs.record.series["team_error"][3, 149, 2] = np.nan
    most = worst(runs, 150)
    assert most[3] == np.inf
    np.testing.assert_allclose(np.delete(most, 3), 0.2, rtol=1e-6)
    assert late_nees(runs) == 2.0


def test_clouds_are_of_one_run_beside_its_truth() -> None:
    where = plan.world(2, 14, outliers=plan.PUBLISHED)
    stored = clouds.compute(Piece(where, ("cspf",), 0, 1, plan.DRAWN), lambda *_: None)
    runs = {(plan.drawn(2), "cspf", plan.DRAWN): clouds.load(where, *stored)}
    results: Any = SimpleNamespace(get=lambda *what: runs.get(what))
    found = clouds.clouds(results, 2)
    assert found is not None
    assert found.particles.shape == (14, 3, 50, 2)
    assert not found.truth[:, 0].any()
    assert not found.particles[:, 0].any()
    spread = found.particles[:, 1:].std(2).mean((1, 2))
    assert spread[-1] < 0.5 * spread[0]
    assert found.wrong.nonzero().flatten().tolist() == [13]
    runs.clear()
    assert clouds.clouds(results, 2) is None
    assert clouds.plane(results) is clouds.coordinates(results) is clouds.space(results) is None


@pytest.mark.slow
def test_particles_errors_are_of_the_run_that_the_study_has() -> None:
    """Beside the smoother's run in the same world: the filter's estimate lies within its cloud."""
    both, where = ("stein_vi", plan.SMOOTHER), plan.euroc(*plan.SHOWN, 12)
    try:
        scenario = where.build()
    except DataError as error:
        pytest.skip(str(error))
    stored = particle_errors.compute(Piece(where, both[:1], 0, 1, plan.ERRORS), lambda *_: None)
    cloud = particle_errors.load(where, *stored)
    assert cloud.shape == (12, 20)
    met = evaluate(scenario, both, runs=1, bound=False)
    estimate = met.agents["stein_vi"].error[0, :, 0]
    assert (cloud.amin(-1).numpy() <= estimate).all()
    assert (estimate <= cloud.amax(-1).numpy()).all()
    runs = {agent: Runs(met, agent) for agent in both}
    results: Any = SimpleNamespace(get=lambda *_: cloud, runs=lambda *_: runs)
    figure = particle_errors.errors(results)
    assert figure is not None
    assert len(figure.axes[0].lines) == 22
    del runs[plan.SMOOTHER]
    assert particle_errors.errors(results) is None


def found(good: bool) -> Made:
    """All that claims need, in favour of them all or against."""
    there: dict[Any, Runs] = {}
    for dim in plan.DIMS:
        for outliers in (plan.PUBLISHED, 0.4):
            key = plan.world(dim, outliers=outliers).key
            there[key, "cspf"] = made_up(1.0 if good else 0.5, 0.03 if good else 0.3)
            other = 0.2 if good else 0.9
            there[key, "cspf:consensus=false"] = made_up(other, 0.4)
            there[key, "cspf:particles=1"] = made_up(other, 0.4)
            there[key, "cspf:variant=paper"] = made_up(1.0 if good else 0.0, 0.4)
    return Made(there)


def test_claims_follow_the_runs(settings: Settings) -> None:
    assert {v.verdict for v in judge(claims(settings), found(True))} == {REPRODUCED}
    assert {v.verdict for v in judge(claims(settings), found(False))} == {CONTRADICTED}


def test_what_is_alike_or_absent_is_not_claimed(settings: Settings) -> None:
    some = Made({key: made_up(1.0, 0.03) for key in found(True).found})
    words = {v.claim.words: v.verdict for v in judge(claims(settings), some)}
    one = "2-D: particles converge more often than one particle (annealed Gauss–Newton)"
    assert words[one] == NOT
    assert {v.verdict for v in judge(claims(settings), Made({}))} == {UNKNOWN}
    cut = Made({key: made_up(1.0, 0.03, steps=120) for key in found(True).found})
    judged = judge(claims(settings), cut)
    assert {(v.verdict, v.reason) for v in judged} == {(UNKNOWN, "runs cut before 150 steps")}


def test_every_world_can_be_built_and_fewer_runs_are_at_least_one(tmp_path: Path) -> None:
    settings = Settings(tmp_path, 100, steps=9)
    cells = [*plan.paper(settings), *plan.beyond(settings)]
    variants = {cell.variant for cell in cells}
    worlds = {cell.variant for cell in cells if cell.kind is None}
    assert len(worlds) == len({(*v.overrides, v.scenario) for v in worlds})
    for variant in variants:
        assert variant.build().horizon == 9
    runs = {cell.name: cell.runs for cell in cells}
    assert runs["stein2d-outliers=0.2"] == 100
    assert [runs[plan.teams(None)[i].key] for i in range(4)] == [50, 50, 20, 5]
    one = Settings(tmp_path, 1)
    assert {c.runs for c in (*plan.paper(one), *plan.beyond(one), *plan.real(one))} == {1}


def test_claims_about_recordings_follow_the_runs(settings: Settings) -> None:
    rng = np.random.default_rng(0)

    def some(size: float) -> Runs:
        runs = made_up(1.0, size)
        runs.record.error[:] *= rng.uniform(0.9, 1.1, (RUNS, 1, 1))
        return runs

    better = ("stein_vi", plan.FAST, plan.QUICK)
    worse = (WORLD, *plan.ALONE[1:], *plan.TEAM[1:], *plan.INERTIAL[1:])
    for good, verdict in ((True, REPRODUCED), (False, CONTRADICTED)):
        near, far = (0.1, 0.5) if good else (0.5, 0.1)
        there = {(a,): some(near) for a in better} | {(a,): some(far) for a in worse}
        assert {v.verdict for v in judge(real(settings), Made({}, there))} == {verdict}
    assert {v.verdict for v in judge(real(settings), Made({}))} == {UNKNOWN}
    one = {(a,): some(0.1) for a in (*better, *worse)}
    for each in one.values():
        object.__setattr__(each.record, "error", each.record.error[:1])
    assert {v.reason for v in judge(real(settings), Made({}, one))} == {"one run only"}


@pytest.mark.slow
def test_a_small_page(tmp_path: Path) -> None:
    variants, agents = ["stein2d-outliers=0.2"], ["cspf:particles=1", "pf_joint:anneal=0.96"]
    for report_only in (False, True):  # the second time from the store
        settings = Settings(tmp_path, 2, "paper", 0, agents, variants, 6, report_only=report_only)
        reproduce(cspf(), settings)
    text = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert "`cspf:particles=1` | 2" in text
    assert "16 not measured" in text
    assert (tmp_path / "convergence.png").exists()
    assert (tmp_path / "outliers.png").exists()
