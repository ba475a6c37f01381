"""``coloc reproduce marl``: its plan can be flown, its figures are what they say."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from training.reproduce.marl.report import Figures

from coloc_env.scenarios import parse_scenario
from training.learning import mappo as _mappo  # noqa: F401  (registers its trainings)
from training.learning.registry import TRAININGS
from training.reproduce.marl import plan, report, run
from training.reproduce.marl.plan import Goal, Trained
from training.reproduce.study import Variant

TINY = (("worlds", 4), ("epochs", 2), ("steps", 5), ("passes", 1), ("minibatches", 1))


def quiet(*_: Any) -> None:
    """Tells nobody."""


def test_every_training_exists_and_stays_within_its_budget() -> None:
    keys = [one.key for one in plan.trainings()]
    assert len(set(keys)) == len(keys)
    for one in plan.trainings():
        known = TRAININGS.options_of(one.name)
        chosen = {key: p.default for key, p in known.items()} | dict(one.options)
        assert set(chosen) == set(known)
        scene = parse_scenario(str(chosen["scenario"]))
        assert scene.motion.__class__.__name__ == "RandomCircles"
        steps = chosen["worlds"] * chosen["epochs"] * scene.horizon * scene.arena.n_uavs
        assert steps <= 3e6
        for each in str(chosen["variants"]).split("/"):
            parse_scenario(f"{chosen['scenario']}:{each}".strip(":"))


def test_goals_are_about_policies_that_are_tried_there() -> None:
    tried = {variant.key: policies for variant, policies in plan.variants()}
    for goal in plan.goals():
        assert goal.policy in tried[goal.variant]
    for variant, _ in plan.variants():
        variant.build()


def figures(*per_run: float) -> Figures:
    return Figures(np.array(per_run), 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("least", "strict", "verdict"), [(49, False, "met"), (51, False, "missed"), (1, True, "missed")]
)
def test_a_goal_is_judged_by_the_mean_and_where_strict_by_the_interval(
    least: float, strict: bool, verdict: str
) -> None:
    rival, ours = figures(0.2, 0.4), figures(0.15, 0.15)  # half the rival's; two runs prove little
    found = {"nlos": {"mappo": ours, "ekf": rival}}
    less, said = report._judge(Goal("mappo", "nlos", "ekf", least, strict), found)
    assert less is not None
    assert less.mean == pytest.approx(50.0)
    assert less.low < 0 < less.high
    assert said == verdict


def test_what_was_not_flown_is_not_judged() -> None:
    assert report._judge(plan.goals()[0], {}) == (None, "not measured")


def test_a_tiny_study_trains_flies_resumes_and_reports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = "indoor-v0:n_uavs=2:motion=random:horizon=10"
    ones = [
        Trained("nlos", "NLOS", options=(("scenario", scenario), *TINY)),
        Trained("displacement", "alone", "ippo", (("scenario", scenario), ("base", "none"), *TINY)),
    ]
    small = (("n_uavs", 2), ("motion", "random"), ("horizon", 120))
    there = [(Variant("nlos", "NLOS 30 %", (*small, ("nlos", 0.3))), ("nlos", "displacement"))]
    goals = [Goal("nlos", "nlos", "ekf", -1000), Goal("displacement", "nlos", "ekf", 99)]
    for module in (run, report):
        monkeypatch.setattr(module, "variants", lambda: there)
    monkeypatch.setattr(run, "trainings", lambda: ones)
    monkeypatch.setattr(run, "SEEDS", 1)
    monkeypatch.setattr(report, "goals", lambda: goals)
    notes: list[str] = []
    # In this process: one that is spawned would not see the patches.
    monkeypatch.setattr(run, "train", lambda todo, *_: notes.extend(map(run._train, todo)))
    run.reproduce(tmp_path, 3, 0, None, 1, True, quiet, notes.append)
    assert notes[:2] == ["trained nlos-0", "trained displacement-0"]
    text = (tmp_path / "report.md").read_text()
    assert "| nlos | nlos | `ekf` | ≥ −1000 |" in text
    assert "| met |" in text
    assert "| missed |" in text
    assert (tmp_path / "curves.png").stat().st_size > 10_000
    found = json.loads((tmp_path / "results.json").read_text())["nlos"]["agents"]
    assert set(found) == {"dead_reckoning", *plan.FILTERS, "nlos", "displacement"}
    assert 0 < found["ekf"]["mean_error"] < found["displacement"]["mean_error"]
    # A second time nothing is left to do, and a report alone says the same.
    notes.clear()
    run.reproduce(tmp_path, 3, 0, None, 1, True, quiet, notes.append)
    assert notes == []
    (tmp_path / "report.md").write_text("")
    run.reproduce(tmp_path, 3, 0, None, 1, False, quiet, notes.append)
    assert (tmp_path / "report.md").read_text() == text
    with pytest.raises(ValueError, match=r"unknown training 'nloss' \(did you mean 'nlos'\?\)"):
        run.reproduce(tmp_path, 3, 0, ["nloss"], 1, False, quiet, notes.append)


def test_learning_curves_are_means_over_epochs(tmp_path: Path) -> None:
    folder = tmp_path / "nlos-0" / "metrics" / "scalars"
    folder.mkdir(parents=True)
    lines = [f"{100 * (i + 1)},{3.0 if i < 8 else 4.0}\n" for i in range(17)]
    (folder / "error.csv").write_text("".join(lines))
    ((steps, error),) = report.learning_curve(replace(plan.trainings()[0], key="nlos"), tmp_path)
    assert steps.tolist() == [800, 1600]
    assert error.tolist() == [3.0, 4.0]


def test_the_study_can_be_trained_by_its_commands() -> None:
    assert {one.name for one in plan.trainings()} <= set(TRAININGS)
