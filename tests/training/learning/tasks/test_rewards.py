"""Rewards that train: what they say beside what the filter and the channel really do."""

from collections.abc import Iterator
from typing import Any

import pytest
import torch

from agents.tasks import make_task
from agents.tasks.memory import own_sigma
from agents.tasks.rules import Seen
from agents.tasks.task import Task
from coloc_env.envs.mode_runner import ModeRunner
from coloc_env.world import World
from training.learning.tasks.environment import environment
from training.learning.tasks.rewards import Difference

WORLDS = 8


def steps(task: Task, policy: str, count: int) -> Iterator[tuple[World, ModeRunner]]:
    """A heuristic's steps: the world and the runner after each; first the start's."""
    world = World(task.scenario, WORLDS)
    runner = ModeRunner(task, world)
    world.reset(torch.arange(WORLDS))
    leaves, random = runner.reset(), torch.Generator().manual_seed(0)
    yield world, runner
    for _ in range(count):
        mask = leaves["action_mask"] > 0 if "action_mask" in leaves else None
        seen = Seen(task, leaves["observation"], mask, runner.memory, random)
        action = task.policies[policy](seen).to(torch.float32)
        runner.step(runner.estimate(action))
        leaves = runner.observe()
        yield world, runner


@pytest.mark.parametrize("policy", ["local", "random", "own_gain"])
def test_differences_predict_the_filter(policy: str) -> None:
    """The σ after the calls that were made, collisions included, is that of the filter itself,
    which was given the ranges of the World's own channel."""
    task = make_task("schedule-v0", horizon=40)
    reward = Difference(task)
    off = []
    for k, (world, runner) in enumerate(steps(task, policy, 30)):
        if k == 0:
            reward.start(runner.memory)
            continue
        calls = task.commands(runner.memory, runner.memory.more["called"]).calls
        assert calls is not None
        found = reward.sigmas(calls.unsqueeze(1), reward.before, world.now.target)[:, 0]
        actual = (2**0.5 * own_sigma(runner.memory.joint)).clamp(max=10.0).mean(-1)
        off.append(found / actual - 1)
        reward.before = runner.memory.joint
    assert torch.stack(off).abs().mean() < 0.01
    assert torch.stack(off).abs().max() < 0.15


def test_a_lone_call_is_worth_what_it_gains_and_silence_nothing() -> None:
    task = make_task("schedule-v0", horizon=20)
    reward = Difference(task)
    for k, (world, runner) in enumerate(steps(task, "slots", 12)):
        if k == 0:
            reward.start(runner.memory)
            continue
        called = runner.memory.more["called"] > 0
        worth = reward(runner.memory, world)[..., 0]
        assert (worth[~called] == 0).all()
        assert (worth[called] >= -1e-5).all()
    assert (worth[called] > 1e-3).any()


def test_who_spoils_others_calls_pays() -> None:
    """With everybody calling, silence of one frees others: most are worth less than nothing."""
    task = make_task("schedule-v0", horizon=20)
    reward = Difference(task)
    total = torch.zeros(())
    for k, (world, runner) in enumerate(steps(task, "own_gain", 12)):
        if k == 0:
            reward.start(runner.memory)
        else:
            total = total + reward(runner.memory, world).sum()
    assert total < 0


@pytest.mark.parametrize("name", ["convoy-v0", "survey-v0", "relay-v0"])
def test_scores_are_of_the_true_error_whatever_reward_trains(name: str) -> None:
    kept: dict[str, Any] = {"hold": 1, "difference": False, "network": "feedforward"}
    believed = environment(make_task(f"{name}:reward=sigma", horizon=12), 4, 3, "cpu", **kept)
    true = environment(make_task(name, horizon=12), 4, 3, "cpu", **kept)
    a, b = believed.reset(), true.reset()
    torch.manual_seed(0)
    apart = 0.0
    for _ in range(12):
        action = torch.rand(4, true.base_env.mode.n_agents, 2)
        a["uav", "action"] = b["uav", "action"] = action
        a, b = believed.step(a)["next"], true.step(b)["next"]
        torch.testing.assert_close(a["score"], b["score"])
        torch.testing.assert_close(b["score"], b["uav", "reward"].mean(1))
        apart += float((a["uav", "reward"] - b["uav", "reward"]).abs().sum())
    assert apart > 0


def test_held_decisions_add_up() -> None:
    """One decision held for five steps is five steps of the same action."""
    task = make_task("convoy-v0", horizon=20)
    kept: dict[str, Any] = {"difference": False, "network": "feedforward"}
    held = environment(task, 3, 5, "cpu", hold=5, **kept)
    single = environment(make_task("convoy-v0", horizon=20), 3, 5, "cpu", hold=1, **kept)
    a, b = held.reset(), single.reset()
    action = torch.tensor([1.0, 0.0]).expand(3, 4, 2)
    for _ in range(4):
        a["uav", "action"] = action
        a = held.step(a)["next"]
        total = torch.zeros(3, 4, 1)
        for _ in range(5):
            b["uav", "action"] = action
            b = single.step(b)["next"]
            total += b["uav", "reward"]
        torch.testing.assert_close(a["uav", "reward"], total)
        torch.testing.assert_close(a["score"], total.mean(1))
        torch.testing.assert_close(a["uav", "observation"], b["uav", "observation"])
    assert a["truncated"].all()
