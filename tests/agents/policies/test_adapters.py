"""Both policy adapters: the same estimates through either face, episodes, failures and subsets."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from tensordict import TensorClass
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import InitTracker, TransformedEnv

from agents.localizer import Estimate, Localizer
from agents.policies.adapters import LocalizerPolicy, ParallelPolicy
from coloc_env.envs.pettingzoo import CoLocParallelEnv
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario

N = 3


class Count(TensorClass["nocast"]):
    step: Tensor
    started: Tensor


class Belief(TensorClass["nocast"]):
    position: Tensor
    count: Count


class Gossip(Localizer[Belief]):
    """Prior mean, pulled to the mean of what is heard, plus the steps since the start."""

    name = "gossip"

    def reset(self, observation: Observation) -> Belief:
        shape = observation.batch_size
        count = Count(
            step=torch.zeros(shape, dtype=torch.int64),
            started=torch.zeros(shape, dtype=torch.bool),
            batch_size=shape,
        )
        return Belief(position=observation["prior"][..., :3].clone(), count=count, batch_size=shape)

    def step(self, belief: Belief, observation: Observation) -> tuple[Belief, Estimate]:
        mask = observation["message_mask"].unsqueeze(-1)
        heard = observation["messages"].unflatten(-1, (-1, 9))[..., :3]
        mean = (heard * mask).sum(-2) / mask.sum(-2).clamp_min(1)
        pulled = torch.where(mask.any(-2), 0.9 * belief.position + 0.1 * mean, belief.position)
        position = pulled + 0.001 * observation["imu"][..., :3]
        count = Count(
            step=belief.count.step + 1,
            started=torch.ones_like(belief.count.started),
            batch_size=belief.batch_size,
        )
        estimate = Estimate(
            position=position + 0.01 * belief.count.step.unsqueeze(-1),
            velocity=torch.zeros_like(position),
            covariance=torch.eye(3).expand(*position.shape, 3),
            batch_size=belief.batch_size,
        )
        return Belief(position=position, count=count, batch_size=belief.batch_size), estimate


def scenario(**overrides: object) -> Scenario:
    return make_scenario("indoor-v0", **{"n_uavs": N, "horizon": 12} | overrides)


def play(scene: Scenario, seed: int, act: Callable[[dict], dict]) -> list[dict]:
    """Actions of one PettingZoo episode."""
    env, actions = CoLocParallelEnv(scene), []
    observations, _ = env.reset(seed)
    while env.agents:
        actions.append(act({a: observations[a] for a in env.agents}))
        observations, *_ = env.step(actions[-1])
    return actions


def failing(**overrides: object) -> Scenario:
    scene = scenario(**overrides)
    object.__setattr__(scene, "failures", ((1, 5),))
    return scene


@pytest.mark.parametrize("carry", ["module", "tensordict"])
@pytest.mark.parametrize("make", [scenario, failing])
def test_both_faces_act_alike(carry: str, make: Callable[..., Scenario]) -> None:
    scene, seeds = make(), (4, 5)
    localizer = Gossip(scene.believed)
    policy = LocalizerPolicy(localizer, scene, carry)
    env = TransformedEnv(CoLocEnv(scene, len(seeds), seed=seeds[0]), InitTracker())
    env.append_transform(policy.make_tensordict_primer())
    rollout = env.rollout(12, policy)
    for row, seed in enumerate(seeds):
        alone = ParallelPolicy(localizer)
        for step, actions in enumerate(play(scene, seed, alone)):
            for i in range(N):
                if f"uav_{i}" in actions:
                    np.testing.assert_array_equal(
                        rollout["uav", "action"][row, step, i].numpy(), actions[f"uav_{i}"]
                    )


@pytest.mark.parametrize("carry", ["module", "tensordict"])
def test_collector_restarts_the_rows_that_are_done(carry: str) -> None:
    scene = scenario()
    policy = LocalizerPolicy(Gossip(scene.believed), scene, carry)
    env = CoLocEnv(scene, 2, seed=7)
    collector = Collector(
        env, policy, frames_per_batch=40, total_frames=80, auto_register_policy_transforms=True
    )
    actions = torch.cat([batch["uav", "action"] for batch in collector], 1)
    collector.shutdown()
    worlds = [
        np.array([list(a.values()) for a in play(scene, seed, ParallelPolicy(policy.localizer))])
        for seed in range(7, 19)
    ]
    for row in range(2):
        met = []
        for start in (0, 12, 24):
            episode = actions[row, start : start + 12].numpy()
            met += [i for i, world in enumerate(worlds) if np.array_equal(world, episode)]
        assert len(met) == 3  # the constructor may have used up some
        assert met == [met[0], met[0] + 2, met[0] + 4]
        assert met[0] % 2 == row


def test_a_row_restarts_alone() -> None:
    scene = scenario()
    policy = LocalizerPolicy(Gossip(scene.believed), scene)
    env = TransformedEnv(CoLocEnv(scene, 2, seed=0), InitTracker())
    data = env.reset()
    for _ in range(3):
        data = env.step_mdp(env.step(policy(data)))
    data["is_init"] = torch.tensor([[False], [True]])
    policy(data)
    assert policy._belief.count.step.tolist() == [[4] * N, [1] * N]


def test_subsets_of_agents_act_like_the_whole() -> None:
    scene = failing()
    localizer = Gossip(scene.believed)
    whole = play(scene, 3, ParallelPolicy(localizer))
    first = ParallelPolicy(localizer, ["uav_2", "uav_0"])
    second = ParallelPolicy(localizer, ["uav_1"])
    mixed = play(scene, 3, lambda seen: first(seen) | second(seen))
    assert [actions.keys() for actions in mixed[:5]] == [actions.keys() for actions in whole[:5]]
    for one, other in zip(whole, mixed, strict=True):
        assert one.keys() == other.keys()
        for agent in one:
            np.testing.assert_array_equal(one[agent], other[agent])


def test_a_failed_uav_is_silent_and_keeps_its_row() -> None:
    scene = failing()
    policy = ParallelPolicy(Gossip(scene.believed))
    actions = play(scene, 0, policy)
    assert [len(a) for a in actions] == [3] * 5 + [2] * 7
    silent = policy._rows["uav_1"]
    assert not silent["links"].any()
    assert not silent["imu"].any()
    assert silent["prior"].any()
    assert silent["landmark_map"].any()


def test_reset_begins_a_new_episode() -> None:
    scene = scenario()
    policy = ParallelPolicy(Gossip(scene.believed))
    first = play(scene, 1, policy)
    policy.reset()
    again = play(scene, 1, policy)
    np.testing.assert_array_equal(first[-1]["uav_0"], again[-1]["uav_0"])


def test_clear_words() -> None:
    scene = scenario()
    localizer = Gossip(scene.believed)
    with pytest.raises(ValueError, match="carry='disk'"):
        LocalizerPolicy(localizer, scene, "disk")
    with pytest.raises(ValueError, match="lacks uav_9"):
        play(scene, 0, ParallelPolicy(localizer, ["uav_9"]))
    with pytest.raises(KeyError, match="InitTracker"):
        CoLocEnv(scene, 2).rollout(2, LocalizerPolicy(localizer, scene))
