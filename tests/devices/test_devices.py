"""Worlds, filters and networks on a card that is only pretended: nothing mixes devices, nothing is
copied back inside the loop, and the numbers are the CPU's."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pretended import OnCard, card
from typer.testing import CliRunner

from agents import make
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.scenarios.registry import SCENARIOS
from training.bench.agents import Task, tasks
from training.cli.command import app
from training.evaluation.animation import frames
from training.evaluation.evaluate import evaluate
from training.evaluation.rollout import rollout

STEPS = 3
SAME = 1e-5
OFF_CARD = ("pose_graph",)  # GTSAM works on the CPU
AT_HOME = [
    task
    for task in tasks()
    if task.group not in ("particles", "teams") and "compile" not in task.agent
]
FEW = {"swarm-v0": {"n_uavs": 20}}


def test_the_card_refuses_what_a_card_refuses() -> None:
    with card() as reads:
        here, there = torch.ones(3), torch.ones(3, device="cuda")
        assert there.device.type == "cuda"
        assert isinstance(there * 2 + torch.tensor(1.0), OnCard)
        with pytest.raises(RuntimeError, match="two devices"):
            here + there
        with pytest.raises(TypeError, match="numpy"):
            there.numpy()
        assert not reads
        assert there.cpu().numpy().tolist() == [1.0, 1.0, 1.0]
        assert float(there.sum()) == 3.0
        assert there[there > 0].shape == (3,)
        assert reads == {"_to_copy": 1, "_local_scalar_dense": 1, "index": 1}


def _same_there(agent: str, scenario: Scenario) -> None:
    localizer, seeds = make(agent, scenario), torch.arange(2)
    here = [step.action.clone() for step in rollout(localizer, scenario, seeds, STEPS)]
    with card() as reads, torch.no_grad():
        localizer.to("cuda")
        for k, step in enumerate(rollout(localizer, scenario, seeds, STEPS, device="cuda")):
            assert isinstance(step.action, OnCard)
            torch.testing.assert_close(step.action.inner, here[k], rtol=SAME, atol=SAME)
            if k and localizer.name not in OFF_CARD:
                assert {"_to_copy", "copy_"}.isdisjoint(reads), dict(reads)
            reads.clear()


@pytest.mark.parametrize("agent", ["ekf", "pfnn"])
def test_a_filter_and_a_network(agent: str) -> None:
    _same_there(agent, make_scenario("indoor-v0", n_uavs=2))


def test_a_team_with_imus() -> None:
    _same_there("cspf:particles=4", make_scenario("stein3d-v0", imu=True, motion="random"))


@pytest.mark.slow
@pytest.mark.parametrize("task", AT_HOME, ids=lambda task: f"{task.agent}-{task.scenario}")
def test_every_localizer(task: Task) -> None:
    overrides = dict(task.overrides) | FEW.get(task.scenario, {})
    _same_there(task.agent, make_scenario(task.scenario, **overrides))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SCENARIOS))
def test_every_scenario(name: str) -> None:
    try:
        scenario = make_scenario(name, **FEW.get(name, {}))
    except (ValueError, OSError) as error:
        pytest.skip(f"a recording that is not here: {error}")
    _same_there("dead_reckoning", scenario)


def test_an_evaluation() -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2, horizon=6)
    here = evaluate(scenario, ["ekf"], 2, bound=False)
    with card():
        there = evaluate(scenario, ["ekf"], 2, bound=False, device="cuda")
    assert there.errors == {}
    one, other = there.agents["ekf"], here.agents["ekf"]
    for name in ("offset", "error", "nees", "covariance"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=SAME, atol=SAME)
    np.testing.assert_array_equal(one.worlds.truth, other.worlds.truth)
    assert type(one.error) is np.ndarray


def test_a_picture() -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2)

    def last(device: str) -> Any:
        localizer = make("ekf", scenario).to(device)
        return list(frames(localizer, scenario, 0, 2, 2, lambda k: None, device))[-1]

    here = last("cpu")
    with card():
        np.testing.assert_array_equal(last("cuda"), here)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a card")
@pytest.mark.parametrize("device", ["cuda", "cuda:1", "nonsense"])
@pytest.mark.parametrize(
    "words",
    [
        ["evaluate", "indoor-v0", "--agents", "ekf"],
        ["reproduce", "cspf"],
        ["render", "indoor-v0"],
        ["bench"],
        ["train", "trust"],
    ],
    ids=lambda words: words[0],
)
def test_no_card_is_said_in_a_line(words: list[str], device: str, tmp_path: Path) -> None:
    out = tmp_path / ("out.png" if words[0] == "render" else "out")
    done = CliRunner().invoke(app, [*words, "--out", str(out), "--device", device])
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr.startswith(
        f"error: --device {device} is not there: cpu available; for a GPU"
    )
    assert done.stderr.count("\n") == 1
    assert not out.exists()
