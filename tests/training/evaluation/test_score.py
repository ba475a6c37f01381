"""The protocol of tasks: statistics against scipy, fixed worlds, own policies, refusals."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import trim_mean
from torch import Tensor
from typer.testing import CliRunner

from agents.tasks import make_task
from agents.tasks.rules import Seen
from agents.tasks.runner import rollout
from training.cli.command import app
from training.evaluation.score import FIRST_SEED, bootstrap, interquartile_mean, score
from training.evaluation.task_policies import from_pettingzoo


def by_observation(seen: Seen) -> Tensor:
    """Straight on, by what agents see alone."""
    return torch.cat((torch.ones_like(seen.observation[..., :1]), -seen.observation[..., 1:2]), -1)


def too_wide(seen: Seen) -> Tensor:
    return torch.zeros(*seen.observation.shape[:2], 3)


def no_tensor(seen: Seen) -> list[float]:
    return [0.0]


def broken(seen: Seen) -> Tensor:
    return seen.observation / (1 // 0)


def not_a_number(seen: Seen) -> Tensor:
    return torch.full((*seen.observation.shape[:2], 2), float("nan"))


def test_the_interquartile_mean_and_its_interval() -> None:
    values = np.random.default_rng(1).normal(5.0, 2.0, 400)
    assert interquartile_mean(values) == pytest.approx(trim_mean(values, 0.25))
    low, high = bootstrap(values)
    assert low < interquartile_mean(values) < high
    spread = 2.0 * 1.19**0.5 / 20  # asymptotic, of a Gaussian: 1.19 times the mean's variance
    assert high - low == pytest.approx(2 * 1.96 * spread, rel=0.2)


def test_returns_are_those_of_the_worlds_one_by_one() -> None:
    found = score("convoy-v0:horizon=20", "leapfrog", 4)
    task = make_task("convoy-v0:horizon=20")
    for i, value in enumerate(found["returns"]):
        alone = rollout(task, task.policies["leapfrog"], torch.tensor([FIRST_SEED + i]))
        assert sum(float(step.reward.mean()) for step in alone) == pytest.approx(value, abs=1e-4)
    assert found["share_of_span"] == pytest.approx(1.0)
    assert found["return"] == pytest.approx(np.mean(found["returns"]))
    assert found["bytes"] == 4 * 20 * 24  # UAVs, steps, bytes
    json.dumps(found, allow_nan=False)


def test_a_policy_of_ones_own_scores_from_the_command_line(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "score.json"
    own = f"{__name__}:by_observation"
    words = ["score", "convoy-v0:horizon=15", "--policy", own, "--worlds", "4", "--out", str(out)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert "interquartile mean" in result.output
    found: dict[str, Any] = json.loads(out.read_text())
    assert found["return"] > found["random"]
    assert set(found["cooperation"]) == {"without_uav_ranges", "worth"}


@pytest.mark.parametrize(
    ("task", "policy", "words"),
    [
        ("survey", "frontier", "unknown task 'survey' (did you mean 'survey-v0'?)"),
        ("survey-v0", "fronteir", "(did you mean 'frontier'?)"),
        ("survey-v0", "no.such.module:x", "No module named"),
        ("survey-v0", f"{__name__}:nothing", "has no attribute 'nothing'"),
        ("survey-v0", f"{__name__}:too_wide", "actions of shape (4, 4, 3) do not fit"),
        ("survey-v0", f"{__name__}:not_a_number", "holds NaN or infinity"),
        ("survey-v0", f"{__name__}:no_tensor", "returns list, not a tensor"),
        ("survey-v0", f"{__name__}:broken", "by zero (test_score.py, line "),
        ("survey-v0", "os:system", "TypeError: expected str, bytes or os.PathLike object"),
        ("survey-v0", "os:name", "'str' object is not callable"),
        ("survey-v0", ".a:b", "relative import"),
        ("survey-v0", ":b", "Empty module name"),
        ("survey-v0:drift=0.1:drift=0.2", "frontier", "survey-v0: drift is given twice"),
    ],
)
def test_what_does_not_fit_is_one_line(task: str, policy: str, words: str) -> None:
    result = CliRunner().invoke(app, ["score", task, "--policy", policy, "--worlds", "4"])
    assert result.exit_code == 2
    assert words in result.output
    assert len(result.output.strip().splitlines()) == 1


def test_tasks_are_listed_with_their_heuristics() -> None:
    listed = CliRunner().invoke(app, ["tasks"])
    assert "survey-v0" in listed.output
    assert "relay-v0" in listed.output
    one = CliRunner().invoke(app, ["tasks", "survey-v0"])
    assert one.exit_code == 0, one.output
    assert "drift" in one.output
    assert "frontier" in one.output


def test_any_pettingzoo_policy_scores() -> None:
    """One for a single world, by agents' names, scores as the same one for many at once."""

    class Ahead:
        def __call__(self, observations: dict[str, Any], infos: dict[str, Any]) -> dict[str, Any]:
            return {a: np.array([1.0, -o[1]], np.float32) for a, o in observations.items()}

    task = "convoy-v0:horizon=10"
    found = score(task, from_pettingzoo(Ahead), 5)
    assert found["returns"] == score(task, by_observation, 5)["returns"]

    def silent(observations: dict[str, Any], infos: dict[str, Any]) -> dict[str, Any]:
        assert all(info["action_mask"][0] == 1 for info in infos.values())
        return {}

    with pytest.raises(ValueError, match="no action for uav_0"):
        score("schedule-v0:horizon=3", from_pettingzoo(lambda: silent), 4)


@pytest.mark.slow
def test_several_seeds_have_an_interval_of_their_own() -> None:
    found = score("convoy-v0:horizon=25", "all_go,half_speed,leapfrog,idle", 5)
    each = [
        score("convoy-v0:horizon=25", name, 5)["return"]
        for name in ("all_go", "half_speed", "leapfrog", "idle")
    ]
    assert found["seeds"]["returns"] == pytest.approx(each)
    assert found["seeds"]["interquartile_mean"] == pytest.approx(trim_mean(each, 0.25))
    low, high = found["seeds"]["interval_95"]
    assert low < found["seeds"]["interquartile_mean"] < high
    assert found["return"] == pytest.approx(np.mean(each))


def test_scores_are_of_the_true_error_whatever_was_trained_on() -> None:
    trained = score("track-v0:horizon=6:reward=sigma:obs=dict", "pairs", 5)
    assert trained["returns"] == score("track-v0:horizon=6", "pairs", 5)["returns"]
