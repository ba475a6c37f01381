"""Seeds: what they fix, and that nothing else does."""

import copy
import random
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from coloc_env.envs.pettingzoo import CoLocParallelEnv, parallel_env
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

Seen = dict[str, dict[str, np.ndarray]]
MIX: dict[str, Any] = {
    "horizon": 25,
    "n_uavs": 4,
    "nlos": 0.2,
    "message_loss": 0.2,
    "failure_rate": 0.5,
    "motion": "random_velocity",
}


def acting(env: CoLocParallelEnv, step: int) -> dict[str, np.ndarray]:
    """Actions from the agent and step alone."""
    return {
        agent: np.random.default_rng((env.possible_agents.index(agent), step))
        .normal(size=9)
        .astype(np.float32)
        for agent in env.agents
    }


def episode(env: CoLocParallelEnv, seed: int | None) -> list[Any]:
    """All that a whole episode brings."""
    brought: list[Any] = [env.reset(seed=seed)]
    k = 0
    while env.agents:
        brought.append((*env.step(acting(env, k)), env.state(), list(env.agents)))
        k += 1
    return brought


def equal(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[k], b[k]) for k in a)
    if isinstance(a, (tuple, list)):
        return len(a) == len(b) and all(equal(x, y) for x, y in zip(a, b, strict=True))
    return bool(np.array_equal(a, b))


def test_whole_episodes_repeat_under_their_seed_and_differ_under_another() -> None:
    first, second = parallel_env(**MIX), parallel_env(**MIX)
    a, b = episode(first, 3), episode(second, 3)
    assert len(a) > 10
    assert equal(a, b)
    assert equal(episode(first, 3), a)  # again, in a world that has been used
    other = episode(second, 4)
    assert not equal(a[0], other[0])
    shared = min(len(a), len(other)) - 1
    for k in (1, shared):
        assert not equal(a[k][0], other[k][0])


def test_episodes_without_a_seed_go_on_from_the_last() -> None:
    env = parallel_env(**MIX)
    env.reset(seed=10)
    following = [env.reset()[0] for _ in range(3)]
    for k, observations in enumerate(following):
        assert equal(env.reset(seed=11 + k)[0], observations)


def test_a_first_episode_without_a_seed_differs_from_run_to_run() -> None:
    a, b = parallel_env(**MIX).reset()[0], parallel_env(**MIX).reset()[0]
    assert not equal(a, b)


def test_the_worlds_numbers_do_not_depend_on_global_generators_or_actions() -> None:
    def run(seed: int) -> list[torch.Tensor]:
        torch.manual_seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        random.seed(seed)
        world = World(make_scenario("indoor-v0", **MIX), 3)
        world.reset(0)
        leaves = []
        for _ in range(8):
            world.step(torch.randn(3, 4, 9))
            seen = world.observation()
            leaves += [v for k, v in seen.leaves.items() if k != "messages"]
            leaves.append(world.truth.position)
        return leaves

    assert all(torch.equal(a, b) for a, b in zip(run(1), run(2), strict=True))


def test_the_world_leaves_global_generators_alone() -> None:
    torch.manual_seed(0)
    state, arrays, plain = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    episode(parallel_env(**MIX), 0)
    env = CoLocEnv(num_envs=2, **MIX)
    tensordict = env.reset()
    tensordict["uav", "action"] = torch.zeros(2, 4, 9)
    env.step(tensordict)
    assert torch.equal(torch.get_rng_state(), state)
    assert random.getstate() == plain
    assert all(np.array_equal(a, b) for a, b in zip(np.random.get_state(), arrays, strict=True))  # noqa: NPY002


@pytest.mark.parametrize("seed", [0, 1, 2**31, 2**62 - 2, np.int64(5)])
def test_any_whole_number_is_a_seed(seed: int) -> None:
    a, b = parallel_env(n_uavs=2), parallel_env(n_uavs=2)
    assert equal(a.reset(seed=seed), b.reset(seed=seed))
    assert not equal(a.reset(seed=seed), b.reset(seed=seed + 1))


def test_an_integer_seeds_a_batch_row_by_row() -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2)
    world = World(scenario, 3)
    a, b, c = world.reset(5), world.reset([5, 6, 7]), world.reset(torch.tensor([5, 6, 7]))
    for name in a.leaves:
        assert torch.equal(a[name], b[name])
        assert torch.equal(a[name], c[name])


def rows_of(tensordict: TensorDict) -> torch.Tensor:
    """What distinguishes one world from another."""
    return tensordict["uav", "observation", "landmark_map"][:, 0]


def maps(seeds: range) -> torch.Tensor:
    world = World(make_scenario("indoor-v0", **MIX), len(seeds))
    return world.reset(list(seeds))["landmark_map"][:, 0]


def test_torchrl_rows_are_the_worlds_of_consecutive_seeds() -> None:
    env = CoLocEnv(num_envs=3, seed=20, **MIX)
    assert torch.equal(rows_of(env.reset()), maps(range(20, 23)))
    assert torch.equal(rows_of(env.reset()), maps(range(23, 26)))
    env.set_seed(20)
    first = env.reset()
    assert torch.equal(rows_of(first), maps(range(20, 23)))
    first["_reset"] = torch.tensor([[False], [True], [False]])
    partly = env.reset(first)
    assert torch.equal(rows_of(partly)[1], maps(range(24, 25))[0])
    assert torch.equal(rows_of(partly)[[0, 2]], maps(range(20, 23))[[0, 2]])
    # The next full reset goes on for every row by itself.
    assert torch.equal(
        rows_of(env.reset()), torch.cat([maps(range(s, s + 1)) for s in (23, 27, 25)])
    )


def test_a_copied_world_goes_its_own_way() -> None:
    world = World(make_scenario("indoor-v0", **MIX), 2)
    world.reset(0)
    for _ in range(3):
        world.step(torch.ones(2, 4, 9))
    twin = copy.deepcopy(world)
    for _ in range(12):
        a, b = world.step(torch.ones(2, 4, 9)), twin.step(torch.ones(2, 4, 9))
        assert torch.equal(a.reward, b.reward)
        seen, seen_too = world.observation(), twin.observation()
        assert all(torch.equal(seen[name], seen_too[name]) for name in seen.leaves)
    twin.step(torch.zeros(2, 4, 9))
    assert torch.equal(world.step_index + 1, twin.step_index)
