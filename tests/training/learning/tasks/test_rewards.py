"""Rewards that train: what they say beside what the filter and the channel really do."""

from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from agents.tasks import make_task
from agents.tasks.task import Seen, Task, own_sigma
from coloc_env.envs.actions import ModeRunner
from coloc_env.world import World
from training.learning.tasks.environment import environment
from training.learning.tasks.rewards import REWARDS, Difference

WORLDS = 8


def steps(task: Task, policy: str, count: int) -> Iterator[tuple[World, ModeRunner, Tensor]]:
    """A heuristic's steps: the world, the runner, and the task's reward; first the start's."""
    world = World(task.scenario, WORLDS)
    runner = ModeRunner(task, world)
    world.reset(torch.arange(WORLDS))
    leaves, random = runner.reset(), torch.Generator().manual_seed(0)
    yield world, runner, torch.zeros(WORLDS, task.n_agents)
    for _ in range(count):
        mask = leaves["action_mask"] > 0 if "action_mask" in leaves else None
        seen = Seen(task, leaves["observation"], mask, runner.memory, random)
        action = task.policies[policy](seen).to(torch.float32)
        reward = runner.step(runner.estimate(action)).reward
        leaves = runner.observe()
        yield world, runner, reward


@pytest.mark.parametrize("policy", ["local", "random", "own_gain"])
def test_differences_predict_the_filter(policy: str) -> None:
    """The σ after the calls that were made, collisions included, is that of the filter itself, which
    was given the ranges of the World's own channel."""
    task = make_task("schedule-v0", horizon=40)
    reward = Difference(task)
    off = []
    for k, (world, runner, _) in enumerate(steps(task, policy, 30)):
        if k == 0:
            reward.start(runner.memory)
            continue
        calls = task.commands(runner.memory, runner.memory.more["called"]).calls
        assert calls is not None
        found = reward._sigmas(calls.unsqueeze(1), reward.before, world.now.target)[:, 0]
        actual = (2**0.5 * own_sigma(runner.memory.joint)).clamp(max=10.0).mean(-1)
        off.append(found / actual - 1)
        reward.before = runner.memory.joint
    assert torch.stack(off).abs().mean() < 0.01
    assert torch.stack(off).abs().max() < 0.15


def test_a_lone_call_is_worth_what_it_gains_and_silence_nothing() -> None:
    task = make_task("schedule-v0", horizon=20)
    reward = Difference(task)
    for k, (world, runner, own) in enumerate(steps(task, "slots", 12)):
        if k == 0:
            reward.start(runner.memory)
            continue
        called = runner.memory.more["called"] > 0
        worth = reward(own.unsqueeze(-1), runner.memory, world)[..., 0]
        assert (worth[~called] == 0).all()
        assert (worth[called] >= -1e-5).all()
    assert (worth[called] > 1e-3).any()


def test_who_spoils_others_calls_pays() -> None:
    """With everybody calling, silence of one frees others: most are worth less than nothing."""
    task = make_task("schedule-v0", horizon=20)
    reward = Difference(task)
    total = torch.zeros(())
    for k, (world, runner, own) in enumerate(steps(task, "own_gain", 12)):
        if k == 0:
            reward.start(runner.memory)
        else:
            total = total + reward(own.unsqueeze(-1), runner.memory, world).sum()
    assert total < 0


@pytest.mark.parametrize(("name", "policy"), [("convoy-v0", "leapfrog"), ("survey-v0", "frontier")])
def test_soft_gates_agree_with_the_hard_one_where_positions_are_known(
    name: str, policy: str
) -> None:
    """Near the anchors the filter is sure, and the reward is the task's own."""
    task = make_task(name, horizon=20)
    reward = REWARDS["soft"](task)
    soft = hard = 0.0
    for k, (world, runner, own) in enumerate(steps(task, policy, 15)):
        if k == 0:
            reward.start(runner.memory)
        given = reward(own.unsqueeze(-1), runner.memory, world)
        soft, hard = soft + float(given.mean()), hard + float(own.mean())
    assert hard > 1
    assert soft == pytest.approx(hard, rel=0.15)


def test_sigma_is_what_the_filter_says() -> None:
    task = make_task("track-v0", horizon=20)
    reward = REWARDS["sigma"](task)
    for world, runner, own in steps(task, "pairs", 3):
        given = reward(own.unsqueeze(-1), runner.memory, world)
        variance = runner.memory.joint.diagonal(dim1=1, dim2=2).diagonal(dim1=1, dim2=2).sum(-1)
        expected = -variance[:, 4:].sqrt().clamp(max=10.0).mean(-1) / 10.0
        torch.testing.assert_close(given[:, 0, 0], expected)


def test_held_decisions_add_up() -> None:
    """One decision held for five steps is five steps of the same action."""
    task = make_task("convoy-v0", horizon=20)
    kept = {"reward": "own", "network": "feedforward"}
    held = environment(task, 3, 5, hold=5, **kept)  # type: ignore[arg-type]
    single = environment(make_task("convoy-v0", horizon=20), 3, 5, hold=1, **kept)  # type: ignore[arg-type]
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
