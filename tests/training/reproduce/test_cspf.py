"""``coloc reproduce cspf``: figures of merit and verdicts on made-up runs, and a small report."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from training.reproduce.cspf import plan, real
from training.reproduce.cspf.claims import verdicts
from training.reproduce.cspf.measures import Runs
from training.reproduce.cspf.run import NAMES, reproduce
from training.reproduce.study import WORLD, Variant
from training.reproduce.verdicts import CONTRADICTED, NOT, REPRODUCED, UNKNOWN

RUNS = 100


def made_up(share: float, worst: float, steps: int = plan.LATE) -> Runs:
    """The first ``share`` of 100 runs converges at step 100, its worst error ``worst`` m."""
    close = np.zeros((RUNS, steps, 3))
    close[: round(share * RUNS), 100:] = 1
    error = np.full((RUNS, steps, 3), 0.5 * worst)
    error[:, :, 1] = worst
    one = SimpleNamespace(
        series={"converged": close, "team_error": error},
        broken=np.zeros(RUNS, bool),
        error=error,
        nees=np.full_like(error, 2.0),
        ms_per_step=1.0,
    )
    results = SimpleNamespace(
        agents={"x": one}, worlds=SimpleNamespace(scored=np.ones_like(error, bool)), runs=RUNS
    )
    return Runs(results, "x")  # type: ignore[arg-type]


def test_figures_of_merit() -> None:
    runs = made_up(0.4, 0.2)
    assert not runs.converged(100).any()
    assert runs.converged(101).sum() == 40
    runs.one.broken[:10] = True
    assert runs.converged(150).sum() == 30
    assert runs.over_time()[[99, 100]].tolist() == [0.0, 0.3]
    runs.one.series["team_error"][3, 149, 2] = np.nan
    worst = runs.worst(150)
    assert worst[3] == np.inf
    assert (np.delete(worst, 3) == 0.2).all()
    assert runs.nees() == 2.0


def flown(good: bool) -> dict[tuple[str, str], Runs]:
    """All that claims look at, in favour of them all or against."""
    found = {}
    for dim in plan.DIMS:
        for outliers in (plan.PUBLISHED, 0.4):
            key = plan.world(dim, None, outliers=outliers).key
            found[key, "cspf"] = made_up(1.0 if good else 0.5, 0.03 if good else 0.3)
            other = 0.2 if good else 0.9
            found[key, "cspf:consensus=false"] = made_up(other, 0.4)
            found[key, "cspf:particles=1"] = made_up(other, 0.4)
            found[key, "cspf:variant=paper"] = made_up(1.0 if good else 0.0, 0.4)
    return found


def test_claims_follow_the_runs() -> None:
    assert {v.verdict for v in verdicts(flown(True), None)} == {REPRODUCED}
    assert {v.verdict for v in verdicts(flown(False), None)} == {CONTRADICTED}


def test_what_is_alike_or_absent_is_not_claimed() -> None:
    some = {key: made_up(1.0, 0.03) for key in flown(True)}
    words = {v.claim.words: v.verdict for v in verdicts(some, None)}
    one = "2-D: particles converge more often than one particle (annealed Gauss–Newton)"
    assert words[one] == NOT
    assert {v.verdict for v in verdicts({}, None)} == {UNKNOWN}
    cut = {key: made_up(1.0, 0.03, steps=120) for key in flown(True)}
    assert {v.verdict for v in verdicts(cut, None)} == {UNKNOWN}


def test_every_world_can_be_built_and_has_a_key_of_its_own() -> None:
    planned = [v for v, _ in (*plan.shares(9), *plan.teams(9), *plan.hard(9), plan.clouds(9))]
    keys = {variant.key for variant in planned}
    assert len(keys) == len({(*v.overrides, v.scenario) for v in planned})
    for variant in planned:
        assert variant.build().horizon == 9
        assert 1 <= plan.runs_in(variant, 10) <= 10
    for uavs, runs in ((3, 50), (10, 20), (20, 5)):
        assert plan.runs_in(Variant("x", "x", (("n_uavs", uavs),)), 100) == runs


def test_claims_about_recordings_follow_the_runs() -> None:
    rng = np.random.default_rng(0)

    def some(size: float) -> Runs:
        runs = made_up(1.0, size)
        runs.one.error *= rng.uniform(0.9, 1.1, (RUNS, 1, 1))
        return runs

    better, worse = ("stein_vi", real.TEAM[0]), (WORLD, "stein_vi:particles=1", *real.TEAM[1:])
    for good, verdict in ((True, REPRODUCED), (False, CONTRADICTED)):
        near, far = (0.1, 0.5) if good else (0.5, 0.1)
        there = {a: some(near) for a in better} | {a: some(far) for a in worse}
        found = {variant.key: there for variant, _ in real.planned(None)}
        judged = real.verdicts(found, None)
        assert {v.verdict for v in judged} == {verdict}
    assert {v.verdict for v in real.verdicts({}, None)} == {UNKNOWN}
    assert len({v.key for v, _ in real.planned(None)}) == len(real.planned(None))
    header, lines = real.table({"x": {a: some(0.1) for a in better}})
    assert all(len(line) == len(header) for line in lines)


def quiet(*_: object) -> None:
    pass


def test_a_small_report(tmp_path: Path) -> None:
    where, agents = ["stein2d-outliers=0.2"], ["cspf:particles=1", "pf_joint:anneal=0.96"]
    for fly in (True, False):  # the second time from the store
        reproduce(tmp_path, "paper", 2, 0, agents, where, 6, 1, fly, quiet, quiet)
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "`cspf:particles=1` | 2" in text
    assert "16 not measured" in text
    assert "not asked for" in text
    assert json.loads((tmp_path / "paper.json").read_text())["runs"] == 2
    assert all((tmp_path / name).exists() for name in NAMES)
    with pytest.raises(ValueError, match="unknown variant 'stein4d'"):
        reproduce(tmp_path, "paper", 2, 0, None, ["stein4d"], 6, 1, False, quiet, quiet)
