"""The TorchRL face: specs, rollouts, resets of some rows, collectors."""

import pickle
import re
import warnings
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import InitTracker, RewardSum, TransformedEnv, check_env_specs

from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.observation import all_leaves
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "failures": {"failure_rate": 1.0},
    "many": {"n_uavs": 20, "comm_radius": 5.0},
    "anchors": {"anchors": 3, "message_delay": 1, "uwb_dropout": 0.2},
    "bare": {"imu": False, "landmarks": 0, "reward": "log_score"},
    "motion": {"motion": "random_velocity", "reward": "team"},
}


def constant(value: float) -> TensorDictModule:
    """A policy that says the same for every UAV."""
    return TensorDictModule(
        lambda prior: torch.full((*prior.shape[:-1], 9), value),
        in_keys=[("uav", "observation", "prior")],
        out_keys=[("uav", "action")],
    )


@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("variant", VARIANTS)
def test_specs(variant: str, size: int) -> None:
    check_env_specs(CoLocEnv(num_envs=size, horizon=6, **VARIANTS[variant]), seed=3)


def test_specs_under_transforms() -> None:
    env = TransformedEnv(CoLocEnv(num_envs=2, horizon=6), InitTracker())
    env.append_transform(RewardSum(in_keys=[("uav", "reward")], reset_keys=["_reset"]))
    check_env_specs(env)


def test_keys_and_shapes() -> None:
    env = CoLocEnv(num_envs=5, horizon=6)
    assert env.batch_size == torch.Size([5])
    rollout = env.rollout(3)
    leaves = all_leaves(env.scenario)
    assert set(rollout["uav", "observation"].keys()) == set(leaves)
    for name, leaf in leaves.items():
        assert rollout["uav", "observation", name].shape == (5, 3, 6, leaf.width)
    assert rollout["uav", "observation"].batch_size == torch.Size([5, 3, 6])
    assert rollout["uav", "action"].shape == (5, 3, 6, 9)
    assert rollout["next", "uav", "reward"].shape == (5, 3, 6, 1)
    assert rollout["uav", "mask"].shape == (5, 3, 6)
    assert rollout["state"].shape == (5, 3, 6 * 12)
    for flag in ("done", "terminated", "truncated"):
        assert rollout["next", flag].shape == (5, 3, 1)


def test_each_row_of_a_rollout_is_its_world() -> None:
    overrides: dict[str, Any] = {"horizon": 7, "nlos": 0.2, "motion": "random_velocity"}
    env = CoLocEnv(num_envs=3, seed=4, **overrides)
    rollout = env.rollout(20, constant(1.0), break_when_any_done=False)
    for row in range(3):
        world = World(make_scenario("indoor-v0", **overrides), 1)
        for k in range(20):
            episode, step = divmod(k, 7)
            if step == 0:
                seen = world.reset([4 + row + 3 * episode])
            now = rollout[row, k]
            for name, leaf in seen.leaves.items():
                assert torch.equal(now["uav", "observation", name], leaf[0]), name
            assert torch.equal(now["state"], world.state()[0])
            scored = world.step(torch.ones(1, 6, 9))
            assert torch.equal(now["next", "uav", "reward"][:, 0], scored.reward[0])
            assert bool(now["next", "done"]) == (step == 6)
            seen = world.observation()
            # A terminal observation is the episode's own, not the next one's.
            for name, leaf in seen.leaves.items():
                assert torch.equal(now["next", "uav", "observation", name], leaf[0]), name


def test_the_horizon_truncates_and_never_terminates() -> None:
    rollout = CoLocEnv(num_envs=2, horizon=4).rollout(10, break_when_any_done=False)
    expected = torch.tensor([k % 4 == 3 for k in range(10)]).expand(2, -1)
    assert torch.equal(rollout["next", "truncated"][..., 0], expected)
    assert torch.equal(rollout["next", "done"][..., 0], expected)
    assert not rollout["next", "terminated"].any()
    assert CoLocEnv(num_envs=2, horizon=4).rollout(10).shape == (2, 4)


def test_a_world_terminates_when_its_last_uav_fails_and_resets_alone() -> None:
    env = CoLocEnv(num_envs=4, seed=0, horizon=12, n_uavs=2, failure_rate=1.0)
    rollout = env.rollout(60, constant(0.0), break_when_any_done=False)
    terminated = rollout["next", "terminated"][..., 0]
    alive = rollout["next", "uav", "mask"]
    assert torch.equal(terminated, ~alive.any(-1))
    assert torch.equal(rollout["next", "done"], rollout["next", "terminated"])
    assert (terminated.sum(1) > 2).all()
    assert not torch.equal(terminated[0], terminated[1])
    for row in range(4):
        ended = terminated[row].nonzero()[:, 0]
        seeds = [row + 4 * e for e in range(len(ended) + 1)]
        starts = [0, *(ended + 1).tolist()]
        for seed, start in zip(seeds, starts, strict=True):
            if start < 60:
                world = World(env.scenario, 1)
                first = world.reset([seed])
                now = rollout["uav", "observation"][row, start]
                for name, leaf in first.leaves.items():
                    assert torch.equal(now[name], leaf[0]), name
        # Rewards of the dead are 0; their last step before failing was scored.
        dead = ~rollout["uav", "mask"][row]
        assert (rollout["next", "uav", "reward"][row][dead] == 0).all()
        assert (rollout["next", "uav", "reward"][row][~dead] < 0).all()


def test_rollouts_stay_as_they_were_returned() -> None:
    env = CoLocEnv(num_envs=3, horizon=9, n_uavs=3, failure_rate=0.9)
    tensordict = env.reset()
    kept: list[tuple[TensorDictBase, TensorDictBase]] = []
    for _ in range(25):
        tensordict["uav", "action"] = torch.ones(3, 3, 9)
        done, tensordict = env.step_and_maybe_reset(tensordict)
        kept.append((done, done.clone()))
        done["uav", "action"].fill_(1e6)
        kept[-1][1]["uav", "action"].fill_(1e6)
    assert all(bool((now == copy).all()) for now, copy in kept)


def test_a_later_write_to_an_action_changes_no_message() -> None:
    env = CoLocEnv(num_envs=2)
    tensordict = env.reset()
    action = torch.ones(2, 6, 9)
    tensordict["uav", "action"] = action
    tensordict = env.step(tensordict)["next"]
    action.fill_(5.0)
    tensordict["uav", "action"] = action
    seen = env.step(tensordict)
    assert float(seen["uav", "observation", "messages"].max()) == 1.0
    assert float(seen["next", "uav", "observation", "messages"].max()) == 5.0


def test_the_true_position_earns_exactly_zero() -> None:
    env = CoLocEnv(num_envs=4, motion="aggressive", horizon=5)

    def oracle(tensordict: TensorDictBase) -> TensorDictBase:
        position = tensordict["state"].unflatten(-1, (6, -1))[..., :3]
        rest = torch.zeros(4, 6, 6)
        return tensordict.set(("uav", "action"), torch.cat((position, rest), -1))

    rollout = env.rollout(12, oracle, break_when_any_done=False)
    assert (rollout["next", "uav", "reward"] == 0).all()


def test_specs_contain_what_sensible_policies_bring() -> None:
    env = CoLocEnv(num_envs=2, horizon=9, anchors=2, failure_rate=0.5)
    rollout = env.rollout(9, constant(0.5), break_when_any_done=False)
    for k in range(9):
        assert env.observation_spec.is_in(
            rollout[:, k].select("state", "uav").exclude(("uav", "action"))
        ), k
        assert env.full_action_spec.is_in(rollout[:, k].select(("uav", "action")))


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (torch.zeros(2, 6, 8), "indoor-v0: actions of shape (2, 6, 8) do not fit: (2, 6, 9)"),
        (torch.full((2, 6, 9), torch.nan), "indoor-v0: the action of uav_0 in world 0 holds NaN"),
    ],
)
def test_wrong_actions_are_named(action: torch.Tensor, words: str) -> None:
    env = CoLocEnv(num_envs=2)
    tensordict = env.reset()
    tensordict["uav", "action"] = action
    with pytest.raises(ValueError, match=re.escape(words)):
        env.step(tensordict)


def test_a_scenario_or_its_id() -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2)
    assert CoLocEnv(scenario).scenario is scenario
    with pytest.raises(ValueError, match="overrides go with a scenario's id"):
        CoLocEnv(scenario, n_uavs=3)
    with pytest.raises(ValueError, match=r"unknown scenario 'outdoor'; known: .*indoor-v0"):
        CoLocEnv("outdoor")
    with pytest.raises(ValueError, match="batch_size=0 is not allowed"):
        CoLocEnv(num_envs=0)


def test_a_reset_that_names_no_row_changes_nothing() -> None:
    env = CoLocEnv(num_envs=2)
    tensordict = env.reset()
    before = tensordict.clone()
    tensordict["_reset"] = torch.zeros(2, 1, dtype=torch.bool)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        after = env.reset(tensordict)
    assert torch.equal(after["state"], before["state"])
    seen = ("uav", "observation", "ranges")
    assert torch.equal(after[seen], before[seen])


def test_a_pickled_environment_goes_on_alike() -> None:
    env = CoLocEnv(num_envs=2, horizon=9, failure_rate=0.5)
    tensordict = env.reset()
    for _ in range(3):
        tensordict["uav", "action"] = torch.zeros(2, 6, 9)
        tensordict = env.step(tensordict)["next"]
    twin = pickle.loads(pickle.dumps(env))
    for _ in range(4):
        tensordict["uav", "action"] = torch.zeros(2, 6, 9)
        a, b = env.step(tensordict.clone()), twin.step(tensordict.clone())
        assert bool((a == b).all())
        tensordict = a["next"]


class _Mean(nn.Module):
    """Says the prior's position and learns nothing of it."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(()))

    def forward(self, prior: torch.Tensor) -> torch.Tensor:
        return self.scale * prior[..., :9]


def test_a_collector_runs() -> None:
    env = CoLocEnv(num_envs=3, horizon=7, n_uavs=2, failure_rate=0.3)
    policy = TensorDictModule(
        _Mean(), in_keys=[("uav", "observation", "prior")], out_keys=[("uav", "action")]
    )
    collector = Collector(
        env, policy, frames_per_batch=30, total_frames=90, auto_register_policy_transforms=False
    )
    batches: list[TensorDict] = [batch.clone() for batch in collector]
    collector.shutdown()
    assert [batch.shape for batch in batches] == [torch.Size([3, 10])] * 3
    together = torch.cat(batches, 1)
    assert together["next", "done"].sum() >= 3 * (30 // 7)
    rewards = together["next", "uav", "reward"][..., 0]
    assert (rewards[together["uav", "mask"]] < 0).all()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_another_device_agrees() -> None:
    overrides: dict[str, Any] = {"nlos": 0.2, "motion": "aggressive", "horizon": 9}
    here = CoLocEnv(num_envs=4, **overrides).rollout(12, constant(0.0), break_when_any_done=False)
    env = CoLocEnv(num_envs=4, device="cuda", **overrides)
    zeros = torch.zeros(4, 6, 9, device="cuda")
    there = env.rollout(
        12, lambda td: td.set(("uav", "action"), zeros), break_when_any_done=False
    ).cpu()
    for key in (("next", "uav", "reward"), ("uav", "observation", "ranges"), ("state",)):
        torch.testing.assert_close(there[key], here[key], rtol=1e-5, atol=1e-5)
