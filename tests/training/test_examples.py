"""The examples run, at sizes of a few seconds, and what they train learns."""

import ast
import importlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import training.examples

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted(Path(training.examples.__file__).parent.glob("[a-z]*.py"))


@pytest.fixture(autouse=True)
def _leave_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def example(name: str, *needs: str) -> Any:
    """An example's module; the test is skipped where a library is missing."""
    for library in needs:
        pytest.importorskip(library)
    return importlib.import_module(f"training.examples.{name}")


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_docstring_names_installation_and_command(script: Path) -> None:
    text = ast.get_docstring(ast.parse(script.read_text())) or ""
    lines = [line.strip() for line in text.splitlines()]
    assert any(line.startswith("pip install") for line in lines)
    assert f"python -m training.examples.{script.stem}" in lines


def test_pettingzoo_loop_and_its_cycle_agree() -> None:
    found = example("pettingzoo_loop").main(episodes=1, horizon=40)
    assert found["landmarks"] < 1.0 < found["random"]
    assert found["landmarks, AEC"] == found["landmarks"]


def test_mixed_team_gives_each_uav_its_method() -> None:
    found = example("mixed_team").main(learned="dead_reckoning", episodes=1, horizon=40, seed=3)
    assert len(found) == 6
    assert found["uav_0"] == max(found.values()) > 1.0
    assert sorted(found.values())[-2] < 1.0


def test_mixed_team_takes_a_learned_policy() -> None:
    assert example("mixed_team").main(episodes=1, horizon=10)["uav_0"] < 0.5


@pytest.mark.slow
def test_gym_single_uav_learns() -> None:
    module = example("gym_single_uav", "stable_baselines3")
    found = module.main(steps=800, envs=2, horizon=50, episodes=2)
    assert found["after"] < 0.7 * found["before"]


@pytest.mark.slow
def test_sb3_ppo_corrects_its_base() -> None:
    found = example("sb3_ppo", "stable_baselines3").main(steps=24_000, number=16, horizon=50)
    assert found["after"] < 0.8 * found["before"]


@pytest.mark.slow
def test_sb3_sac_learns() -> None:
    found = example("sb3_sac", "stable_baselines3").main(steps=4_000, number=4, horizon=50)
    assert found["after"] < 0.5 * found["before"]


@pytest.mark.slow
def test_torchrl_mappo_corrects_its_base() -> None:
    module = example("torchrl_mappo", "torchrl.objectives.multiagent")
    found = module.main(steps=20_000, worlds=16, horizon=50)
    assert found["after"] < 0.8 * found["before"]


def test_supersuit_loses_what_the_example_says() -> None:
    env = example("supersuit_sb3", "supersuit", "stable_baselines3").worlds(2, horizon=5, seed=0)
    first = env.reset()
    assert not np.array_equal(first[:6], first[6:])  # the copies fly different worlds
    for step in range(5):
        _, _, dones, infos = env.step(np.zeros((12, 3), np.float32))
        assert dones.all() == (step == 4)
    assert "TimeLimit.truncated" not in infos[0]
    assert infos[0]["episode_rmse"] == 0.0
    for method in (env.seed, env.get_attr):
        with pytest.raises(AttributeError):
            method("scenario")


@pytest.mark.slow
def test_supersuit_learns() -> None:
    module = example("supersuit_sb3", "supersuit", "stable_baselines3")
    found = module.main(steps=6_000, copies=2, horizon=50)
    assert found["after"] < 0.5 * found["before"]


@pytest.mark.slow
def test_rllib_learns() -> None:
    module = example("rllib_ppo", "ray.rllib")
    found = module.main(iterations=3, steps=400, horizon=50, episodes=1)
    assert found["after"] < found["before"]


@pytest.mark.slow
def test_skrl_learns() -> None:
    found = example("skrl_ippo", "skrl").main(steps=4_000, horizon=50, episodes=1)
    assert found["after"] < 0.95 * found["before"]


@pytest.mark.slow
def test_benchmarl_learns() -> None:
    found = example("benchmarl_mappo", "benchmarl").main(iterations=4, worlds=10, horizon=50)
    assert found["after"] < found["before"]


@pytest.mark.slow
def test_localized_learns_on_estimates() -> None:
    module = example("localized", "vmas")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        before = module.actor_of(module.environment("navigation", "truth", 2, 0))
        estimates = "ranges between agents only"
        after = module.trained("navigation", estimates, steps=60_000, seed=0)
        first, last = (module.measured("navigation", p, estimates, 64) for p in (before, after))
    assert last["return"] > first["return"] + 0.2
    assert 0 < last["error"] < 3


def test_spread_is_the_same_task_in_other_orders_and_axes() -> None:
    """The controller does to mirrored observations what is mirrored of what it does."""
    module = example("localized_spread", "mpe2")
    torch.manual_seed(0)
    seen = torch.cat((torch.randn(60, 14), torch.zeros(60, 4)), 1)
    actions = module.controller(seen.unsqueeze(1)).flatten()
    assert len(set(actions.tolist())) >= 4
    for _ in range(8):
        turned, wanted = module.mirrored(seen, actions)
        assert torch.equal(module.controller(turned.unsqueeze(1)).flatten(), wanted)


def test_spread_side_by_side_is_spread_localized() -> None:
    from agents.wrappers.adapters import simple_spread
    from agents.wrappers.localized import Localized

    module = example("localized_spread", "mpe2")
    worlds = module.Worlds(2, "4 anchors, 30 % NLOS", 5)
    true, task = worlds.reset(), module.simple_spread_v3.parallel_env(max_cycles=25)
    alone = Localized(task, simple_spread, anchors=4, nlos=0.3)
    seen, _ = alone.reset(seed=6)
    for _ in range(4):
        rows = torch.stack([torch.from_numpy(seen[name]) for name in alone.agents])
        torch.testing.assert_close(worlds.known(true)[1], rows.float(), rtol=0, atol=1e-4)
        actions = module.controller(true)
        true, gained = worlds.step(actions)
        mine = dict(zip(alone.agents, actions[1].tolist(), strict=True))
        seen, rewards, *_ = alone.step(mine)
        np.testing.assert_allclose(gained[1], list(rewards.values()))


@pytest.mark.slow
def test_spread_is_learnt_from_estimates() -> None:
    module = example("localized_spread", "mpe2")
    estimates = "ranges between agents only"
    with torch.random.fork_rng():
        policies = (
            lambda seen: torch.randint(5, seen.shape[:2]),
            module.trained(estimates, 0, rounds=3, worlds=40),
        )
        first, last = (module.measured(policy, estimates, 64) for policy in policies)
    assert last["return"] > first["return"] + 4
    assert 0 < last["error"] < 3


@pytest.mark.slow
def test_live_minutes_are_located_and_timed() -> None:
    found = example("live_hour").run(seconds=40, speed=1000)
    assert found["rmse_m"] < 1.0
    assert 50 < found["memory_mb"][0] < 2000
    assert "steps 400" in found["summary"][0]
    assert "second of one link" not in "".join(found["summary"])
    assert "95th percentile" in found["summary"][-1]


def test_benchmarl_runs_tasks_by_its_own_command(tmp_path: Path) -> None:
    """MAPPO where actions are numbers, QMIX where they are choices and masked."""
    example("benchmarl_tasks", "benchmarl", "hydra")
    few = ["experiment.max_n_iters=2", "experiment.loggers=[]", "experiment.evaluation=false"]
    for policy in ("on", "off"):
        few.append(f"experiment.{policy}_policy_collected_frames_per_batch=400")
        few.append(f"experiment.{policy}_policy_n_envs_per_worker=20")
    for algorithm, task in (("mappo", "survey-v0"), ("qmix", "schedule-v0")):
        line = [sys.executable, "-m", "training.examples.benchmarl_tasks", f"task=coloc/{task}"]
        line += [f"algorithm={algorithm}", "task.options='horizon=20'", *few]
        environ = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(line, cwd=tmp_path, env=environ, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert "mean return" in done.stderr
