"""``coloc reproduce marl``: its plan can be run, its figures are what they say."""

import json
from pathlib import Path

import numpy as np
import pytest
from made import Made, runs_of

from coloc_env.scenarios import make_scenario, parse_scenario
from training.learning.registry import TRAININGS
from training.reproduce.marl import learning_curve, marl, study_of
from training.reproduce.marl.plan import FILTERS, Plan, Policy, Target, plan
from training.reproduce.results import Runs
from training.reproduce.settings import Settings
from training.reproduce.study import reproduce
from training.reproduce.verdicts import MET, MISSED, UNKNOWN, judge_goals
from training.reproduce.work import WORLD, Training, Variant

TINY = (("worlds", 4), ("epochs", 2), ("steps", 5), ("passes", 1), ("minibatches", 1))


def test_every_training_exists_and_stays_within_its_budget() -> None:
    policies = plan().policies
    assert len({one.key for one in policies}) == len(policies)
    for one in policies:
        known = TRAININGS.options_of(one.training)
        chosen = {key: p.default for key, p in known.items()} | dict(one.options)
        assert set(chosen) == set(known)
        scenario = parse_scenario(str(chosen["scenario"]))
        assert scenario.motion.__class__.__name__ == "RandomCircles"
        steps = chosen["worlds"] * chosen["epochs"] * scenario.horizon * scenario.arena.n_uavs
        assert steps <= 3e6
        for each in str(chosen["variants"]).split("/"):
            parse_scenario(chosen["scenario"], each)


def test_targets_are_about_policies_that_are_tried_there() -> None:
    tried = {variant.key: policies for variant, policies in plan().worlds}
    for target in plan().targets:
        assert target.policy in tried[target.variant]
    for variant, _ in plan().worlds:
        variant.build()


def runs(*errors: float) -> Runs:
    """Runs with these mean errors."""
    error = np.ones((len(errors), 3, 2)) * np.array(errors)[:, None, None]
    return runs_of(make_scenario("indoor-v0", n_uavs=2, horizon=3), error)


@pytest.mark.parametrize(
    ("least", "clear", "verdict"), [(49, False, MET), (51, False, MISSED), (1, True, MISSED)]
)
def test_a_goal_is_judged_by_the_mean_and_where_asked_by_the_interval(
    least: float, clear: bool, verdict: str, tmp_path: Path
) -> None:
    world = Variant("nlos", "NLOS 30 %")
    the = Plan(
        (Policy("nlos", "x"),),
        ((world, ("nlos",)),),
        (Target("nlos", "nlos", "ekf", least, clear),),
        2,
    )
    (part,) = study_of(the).parts.values()
    settings = Settings(tmp_path, 2)
    # half the rival's error over both seeds; two runs prove little
    seeds = dict(
        zip(the.policies[0].agents(tmp_path, 2), (runs(0.1, 0.1), runs(0.2, 0.2)), strict=True)
    )
    found = {("nlos", agent): one for agent, one in seeds.items()} | {
        ("nlos", "ekf"): runs(0.2, 0.4)
    }
    (one,) = judge_goals(part.goals(settings), Made(found))
    assert one.ours is not None
    assert one.ours.mean == pytest.approx(50.0)
    assert one.ours.low < 0 < one.ours.high
    assert one.verdict == verdict
    (one,) = judge_goals(part.goals(settings), Made({}))
    assert one.verdict == UNKNOWN


@pytest.mark.slow
def test_a_tiny_study_trains_runs_resumes_and_reports(tmp_path: Path) -> None:
    scenario = "indoor-v0:n_uavs=2:motion=random:horizon=10"
    policies = (
        Policy("nlos", "NLOS", options=(("scenario", scenario), *TINY)),
        Policy("displacement", "alone", "ippo", (("scenario", scenario), ("base", "none"), *TINY)),
    )
    small = (("n_uavs", 2), ("motion", "random"), ("horizon", 30))
    world = Variant("nlos", "NLOS 30 %", (*small, ("nlos", 0.3)))
    targets = (Target("nlos", "nlos", "ekf", -1000), Target("displacement", "nlos", "ekf", 99))
    the = study_of(Plan(policies, ((world, ("nlos", "displacement")),), targets, 1))
    lines: list[str] = []
    reproduce(the, Settings(tmp_path, 3), report=lines.append)
    assert lines[0].startswith("1/2 training nlos-0")
    assert lines[1].startswith("2/2 training displacement-0")
    text = (tmp_path / "page.md").read_text()
    assert "| nlos in NLOS 30 %: less than `ekf` | ≥ −1000 % | **met** |" in text
    assert "**missed**" in text
    content = json.loads((tmp_path / "results.json").read_text())
    (table,) = content["sections"][-1]["tables"]
    columns = [f"`{name}`" for name in (WORLD, *FILTERS, "nlos", "displacement")]
    assert table["header"][2:] == columns
    agents = content["figures"]["nlos"]["agents"]
    assert len(agents) == 1 + len(FILTERS) + 2
    # A second time nothing is left to do, and a report alone says the same.
    lines.clear()
    reproduce(the, Settings(tmp_path, 3), report=lines.append)
    assert lines == []
    (tmp_path / "page.md").write_text("")
    reproduce(the, Settings(tmp_path, 3, report_only=True), report=lines.append)
    assert (tmp_path / "page.md").read_text() == text


def test_trainings_are_those_of_the_worlds_asked_for(tmp_path: Path) -> None:
    (part,) = marl().parts.values()
    assert len(list(part.trainings(Settings(tmp_path, 1)))) == 40
    some = part.trainings(Settings(tmp_path, 1, variants=["accel"]))
    assert {training.key.rsplit("-", 1)[0] for training in some} == {"mixed", "accel"}


def test_learning_curves_are_means_over_epochs(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "nlos-0" / "metrics" / "scalars"
    folder.mkdir(parents=True)
    lines = [f"{100 * (i + 1)},{3.0 if i < 8 else 4.0}\n" for i in range(17)]
    (folder / "error.csv").write_text("".join(lines))
    ((steps, error),) = learning_curve(Training("nlos-0", "mappo"), tmp_path)
    assert steps.tolist() == [800, 1600]
    assert error.tolist() == [3.0, 4.0]
    assert list(learning_curve(Training("nlos-1", "mappo"), tmp_path)) == []
