"""Tasks on every face: exact seeding with actions, bounded observations, errors, and that decisions
matter: others' acts and ranges between UAVs change what uav_0 gets."""

from typing import Any

import gymnasium
import numpy as np
import pettingzoo
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor
from torchrl.envs.utils import check_env_specs

import coloc_env
from agents import tasks
from agents.tasks import TASKS, make_task
from agents.tasks.gains import anchor_gains, range_gains
from agents.tasks.rules import Seen
from agents.tasks.runner import rollout
from agents.tasks.single import SingleAgentTask
from agents.tasks.task import Task
from coloc_env import noise
from coloc_env.envs.sb3 import CoLocVecEnv
from coloc_env.envs.torchrl import CoLocEnv, PerUavEnv

NAMES = sorted(TASKS)
PLANE = [name for name in NAMES if "hard" not in name]
EVERY = [n if n in PLANE else pytest.param(n, marks=pytest.mark.slow) for n in NAMES]
SHORT = 12


def short(name: str, **options: Any) -> Task:
    return make_task(name, horizon=SHORT, **options)


def actions_of(task: Task, seeds: Tensor, k: int) -> Tensor:
    """A row's actions, from its seed and step alone."""
    keys = noise.fold(noise.row_keys(seeds), k)
    n = task.n_agents
    if task.choices is None:
        return noise.normal(keys, "actions", task.width * n).unflatten(-1, (n, -1)).clamp(-1, 1)
    return (noise.uniform(keys, "actions", n) * task.choices).long()


def parallel(task: Task, seed: int, n: int = SHORT) -> tuple[list[Tensor], list[Tensor]]:
    """Observations and rewards of an episode on the PettingZoo face."""
    env = coloc_env.parallel_env(task.scenario, action=task)
    found, _ = env.reset(seed=seed)
    seen, rewards = [torch.from_numpy(np.stack(list(found.values())))], []
    for k in range(n):
        action = actions_of(task, torch.tensor([seed]), k)[0].numpy()
        found, reward, _, truncated, _ = env.step(dict(zip(env.agents, action, strict=True)))
        seen.append(torch.from_numpy(np.stack(list(found.values()))))
        rewards.append(torch.tensor(list(reward.values())))
    assert all(truncated.values()) is (n == SHORT)
    return seen, rewards


@pytest.mark.parametrize("name", EVERY)
def test_faces_agree_and_rows_are_their_seeds_over_a_whole_episode(name: str) -> None:
    task, seeds = short(name), torch.tensor([7, 8, 9])
    env = CoLocEnv(task.scenario, 3, seed=7, action=task)
    td = env.reset()
    vec = CoLocVecEnv(task.scenario, 3, seed=7, action=task)
    flat = vec.reset()
    singles = [parallel(short(name), int(seed)) for seed in seeds]
    for k in range(SHORT):
        for row, (seen, _) in enumerate(singles):
            torch.testing.assert_close(td["uav", "observation"][row], seen[k], rtol=0, atol=1e-5)
        torch.testing.assert_close(
            torch.from_numpy(flat).view(3, task.n_agents, -1), td["uav", "observation"]
        )
        action = actions_of(task, seeds, k)
        td["uav", "action"] = action
        td = env.step(td)["next"]
        flat, rewards, done, _ = vec.step(action.flatten(0, 1).numpy())
        torch.testing.assert_close(
            torch.from_numpy(rewards).view(3, -1), td["uav", "reward"][..., 0]
        )
        for row, (_, each) in enumerate(singles):
            torch.testing.assert_close(td["uav", "reward"][row, :, 0], each[k], rtol=0, atol=1e-5)
        if k + 1 == SHORT:
            assert td["truncated"].all()
            assert done.all()


@pytest.mark.parametrize("name", PLANE)
def test_the_same_actions_make_the_same_worlds_exactly(name: str) -> None:
    first, second = parallel(short(name), 5), parallel(short(name), 5)
    for a, b in zip(first[0] + first[1], second[0] + second[1], strict=True):
        assert torch.equal(a, b)
    other = parallel(short(name), 6)
    assert not torch.equal(other[0][0], first[0][0])


@pytest.mark.parametrize("name", EVERY)
def test_partial_resets_begin_the_world_of_the_seed(name: str) -> None:
    task = short(name)
    env = CoLocEnv(task.scenario, 2, seed=3, action=task)
    td = env.reset()
    for k in range(4):
        td["uav", "action"] = actions_of(task, torch.tensor([3, 4]), k)
        td = env.step(td)["next"]
    before = td["uav", "observation"][0].clone()
    td["_reset"] = torch.tensor([[False], [True]])
    td = env.reset(td)
    assert torch.equal(td["uav", "observation"][0], before)
    seen, rewards = parallel(short(name), 6, 3)
    for k in range(3):
        torch.testing.assert_close(td["uav", "observation"][1], seen[k], rtol=0, atol=1e-5)
        action = torch.cat(
            [actions_of(task, torch.tensor([seed]), j) for seed, j in ((3, 4 + k), (6, k))]
        )
        td["uav", "action"] = action
        td = env.step(td)["next"]
        torch.testing.assert_close(td["uav", "reward"][1, :, 0], rewards[k], rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", EVERY)
def test_libraries_own_checks(name: str) -> None:
    task = short(name)
    parallel_api_test(coloc_env.parallel_env(task.scenario, action=task), num_cycles=30)
    check_env_specs(CoLocEnv(task.scenario, 2, seed=1, action=task))
    check_env_specs(PerUavEnv(CoLocEnv(task.scenario, 2, seed=1, action=task)))
    check_env(gymnasium.make(f"coloc/{name}", horizon=SHORT).unwrapped, skip_render_check=True)
    parallel_api_test(pettingzoo.make("parallel", f"coloc/{name}", horizon=SHORT), num_cycles=20)
    api_test(pettingzoo.make("aec", f"coloc/{name}", horizon=SHORT), num_cycles=20)
    batched = tasks.torchrl_env(name, 2, horizon=SHORT)
    assert batched.group_map == {"uav": [f"uav_{i}" for i in range(task.n_agents)]}
    vec = tasks.vec_env(name, 2, seed=1, horizon=SHORT)
    assert isinstance(vec, VecEnv)
    assert vec.observation_space.contains(vec.reset()[0])


@pytest.mark.parametrize("name", EVERY)
def test_one_uav_among_good_ones_is_a_gymnasium_environment(name: str) -> None:
    """Its episode is that of the PettingZoo face, where the others act by the same heuristic."""
    task = short(name)
    check_env(SingleAgentTask(short(name)), skip_render_check=True)
    env, actions = SingleAgentTask(task), []
    single = [env.reset(seed=4)[0]]
    rule = task.policies[task.best]
    rewards = []
    for k in range(SHORT):
        own = actions_of(task, torch.tensor([4]), k)[0, 0].numpy()
        actions.append(own)
        seen, reward, _, truncated, _ = env.step(own)
        single.append(seen)
        rewards.append(reward)
    assert truncated

    def played(seen: Seen) -> Tensor:
        action = rule(seen).to(torch.float32).clone()
        action[0, 0] = torch.as_tensor(actions[int(seen.memory.step[0, 0])], dtype=torch.float32)
        return action

    for k, step in enumerate(rollout(short(name), played, torch.tensor([4]), seed=4)):
        assert float(step.reward[0, 0]) == rewards[k]
        np.testing.assert_array_equal(step.seen.observation[0, 0].numpy(), single[k])


@pytest.mark.parametrize("name", PLANE)
@pytest.mark.parametrize("policy", ["random", "best"])
def test_what_agents_see_is_bounded_and_never_the_truth(name: str, policy: str) -> None:
    task = short(name)
    rule = task.policies[task.best if policy == "best" else policy]
    for step in rollout(task, rule, torch.arange(6)):
        observation = step.seen.observation
        assert observation.isfinite().all()
        assert observation.abs().max() <= 1.0
        assert observation.shape == (6, task.n_agents, task.leaves["observation"].width)
        assert step.reward.isfinite().all()
        if step.seen.mask is not None:
            assert step.seen.mask[..., 0].all()


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANE)
def test_decisions_matter(name: str) -> None:
    """In the same worlds: heuristics do better than chance and silence; with the others at random
    uav_0 gets less than with the others good; so does a team whose UAVs cannot range each other."""
    task, seeds = make_task(name), torch.arange(500, 516)
    good, random = task.policies[task.best], task.policies["random"]

    def returns(policy: Any, task: Task = task) -> Tensor:
        return torch.stack([step.reward for step in rollout(task, policy, seeds)]).sum(0)

    def mixed(seen: Seen) -> Tensor:
        action = random(seen).to(torch.float32)
        action[:, :1] = good(seen)[:, :1].to(torch.float32)
        return action

    best = returns(good)
    chance = max(float(returns(rule).mean()) for rule in (random, task.policies["idle"]))
    assert float(best.mean()) - chance > 0.2 * abs(chance)
    assert (best - returns(mixed))[:, 0].mean() > 3.0
    assert (best - returns(good, task.without_cooperation())).mean() > 0.5


def test_wrong_actions_and_names_are_one_line() -> None:
    task = short("schedule-v0")
    env = coloc_env.parallel_env(task.scenario, action=task)
    env.reset(seed=1)
    good = dict.fromkeys(env.agents, 0)
    for wrong, words in ((8, "none of the choices"), (-1, "none of the choices"), (0.5, "none of")):
        with pytest.raises(ValueError, match=words) as caught:
            env.step({**good, "uav_2": wrong})
        assert "uav_2" in str(caught.value)
        assert "\n" not in str(caught.value)
    steered = short("survey-v0")
    env = coloc_env.parallel_env(steered.scenario, action=steered)
    env.reset(seed=1)
    nan = {a: np.full(2, np.nan, np.float32) for a in env.agents}
    with pytest.raises(ValueError, match="holds NaN or infinity"):
        env.step(nan)
    with pytest.raises(ValueError, match=r"unknown task 'survey' \(did you mean 'survey-v0'\?\)"):
        make_task("survey")
    with pytest.raises(ValueError, match="unknown option 'drif'"):
        make_task("survey-v0:drif=0.2")
    with pytest.raises(ValueError, match="made for another scenario"):
        coloc_env.parallel_env(short("survey-v0").scenario, action=steered)


# ---------------------------------------------------------------- predicted gains


def test_predicted_gains_are_those_of_a_kalman_update() -> None:
    g = torch.Generator().manual_seed(0)
    n, b = 4, 3
    position = 30 * torch.rand(b, n, 2, generator=g, dtype=torch.float64)
    root = torch.randn(b, 2 * n, 2 * n, generator=g, dtype=torch.float64)
    p = root @ root.mT
    joint = p.unflatten(1, (n, 2)).unflatten(3, (n, 2)).transpose(2, 3)
    gains = range_gains(position, joint)
    anchors = torch.tensor([[0.0, 0.0], [50.0, 10.0]], dtype=torch.float64)
    fixed = anchor_gains(position, joint, anchors)

    def after(h: Tensor, variance: float, row: int) -> Tensor:
        s = h @ p[row] @ h + variance
        taken = torch.outer(p[row] @ h, p[row] @ h) / s
        return taken.diagonal().view(n, 2).sum(-1)

    for row in range(b):
        for i in range(n):
            for j in range(n):
                if i != j:
                    apart = position[row, i] - position[row, j]
                    d = float(apart.norm())
                    h = torch.zeros(2 * n, dtype=torch.float64)
                    h[2 * i : 2 * i + 2], h[2 * j : 2 * j + 2] = apart / d, -apart / d
                    expected = after(h, (0.1 + 0.01 * d) ** 2, row)
                    torch.testing.assert_close(gains[row, i, j], expected)
            for a in range(2):
                apart = position[row, i] - anchors[a]
                d = float(apart.norm())
                h = torch.zeros(2 * n, dtype=torch.float64)
                h[2 * i : 2 * i + 2] = apart / d
                torch.testing.assert_close(fixed[row, i, a], after(h, (0.1 + 0.01 * d) ** 2, row))
