"""The table of all recordings: its marks, and constants chosen on other datasets."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from coloc_env.datasets import DataError
from coloc_env.scenarios import make_scenario
from training.cli.command import app
from training.evaluation import recordings
from training.evaluation.recordings import chosen_elsewhere, measure, recorded, table

CLASSICAL = {"ekf": 1.0, "ekf:robust=huber": 0.8}


def figures(**rmse: float) -> dict[str, dict[str, Any]]:
    every = CLASSICAL | rmse
    rest = {"nees": 3.0, "lost": 0, "uavs": 2, "trust_share": None, "bytes": None}
    return {name: {"rmse": value, **rest} for name, value in every.items()}


def test_constants_are_chosen_without_the_dataset_they_are_judged_on() -> None:
    """``a`` is best on x and y, ``b`` on z alone: on z it is ``a`` that was chosen."""
    found = chosen_elsewhere(
        {
            "x/1": figures(a=0.8, b=1.6),
            "x/2": figures(a=0.8, b=1.6),
            "y/1": figures(a=0.8, b=1.6),
            "z/1": figures(a=1.2, b=0.4),
        },
        (*CLASSICAL, "a", "b"),
    )
    assert found == {
        "x": ("b", pytest.approx(2.0)),  # y and z: log 2 − log 2 < 0 + log 1.5
        "y": ("b", pytest.approx(2.0)),
        "z": ("a", pytest.approx(1.5)),
    }
    with pytest.raises(ValueError, match="only x was measured: another dataset is needed"):
        chosen_elsewhere({"x/1": figures(a=0.8)}, (*CLASSICAL, "a"))


def test_cells_say_what_is_good_lost_refused_and_tuned() -> None:
    one = figures(bank=0.84, bad=0.85, none=1.0)
    one["bank"] |= {"trust_share": 0.256, "bytes": 24.0}
    one["bad"]["lost"] = 1
    one["none"] = {"refused": "why"}
    agents = (*CLASSICAL, "bank", "bad", "none")
    found = table({"x/1": one}, {"x/1": True}, agents, 2, 5, "command", "here")
    assert found["rows"] == [
        ["x/1 ᵗ", "1 (3)", "**0.8** (3)", "**0.84** (3) 26 % 24 B", "0.85 (3) †1/2", "–"]
    ]
    assert "seeds 5 to 6" in found["caption"]
    assert len(found["header"]) == len(found["align"]) == 6


def test_what_is_measured() -> None:
    scenario = make_scenario("wsn-v0", horizon=20)
    found = measure(scenario, ("ekf", "ekf_trust", "stgat"), 2, 0)
    assert found["ekf"]["rmse"] > 0
    assert found["ekf"]["trust_share"] is None
    assert 0 <= found["ekf_trust"]["trust_share"] <= 1
    assert "refused" in found["stgat"]


def test_a_team_of_one_has_nothing_to_fuse() -> None:
    agents = ("ekf:fusion=pairwise", "ekf_joint")
    for n_uavs in (1, 2):
        scenario = make_scenario("indoor-v0", n_uavs=n_uavs, horizon=3)
        found = measure(scenario, agents, 1, 0)
        assert ["refused" in found[agent] for agent in agents] == [n_uavs == 1] * 2


def test_the_list(monkeypatch: pytest.MonkeyPatch) -> None:
    tuned = SimpleNamespace(tuned_on=("a",))
    made = [
        SimpleNamespace(
            dataset="d", sequence=s, scenario_name="replay-d-v0", scenario=lambda: tuned
        )
        for s in ("a", "b")
    ]
    monkeypatch.setattr(recordings, "recorded", lambda: made)
    done = CliRunner().invoke(app, ["recordings"])
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    assert [line.split()[:2] for line in lines[1:]] == [
        ["d/a", "replay-d-v0"],
        ["d/b", "replay-d-v0"],
    ]
    assert ["constants" in line for line in lines[1:]] == [True, False]


def test_a_folder_without_recordings(tmp_path: Path) -> None:
    with pytest.raises(DataError):
        list(recorded(str(tmp_path)))
    done = CliRunner().invoke(app, ["recordings", "--agents", "ekf", "--runs", "0"])
    assert done.exit_code == 2
    assert "--runs 0 is not allowed" in done.stderr
