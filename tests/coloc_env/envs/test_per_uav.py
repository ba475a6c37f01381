"""The flattened view: a row for every UAV, world by world, with CoLocEnv's own numbers."""

import re
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import ExplorationType, RewardSum, TransformedEnv, check_env_specs

from agents.policies.learned import actor_for
from agents.wrappers.correction import with_base
from coloc_env.envs.per_uav import PerUavEnv
from coloc_env.envs.torchrl import CoLocEnv
from training.learning.collectors import episode_collector
from training.learning.mappo import policy_of

B, N, H = 3, 2, 5
MODES = ("estimate", "displacement", "correction")


def worlds(mode: str, seed: int = 0, **overrides: Any) -> CoLocEnv:
    options: dict[str, Any] = {"n_uavs": N, "horizon": H, "motion": "random"} | overrides
    if mode == "correction":
        return with_base(CoLocEnv(num_envs=B, seed=seed, **options))
    return CoLocEnv(num_envs=B, seed=seed, action=mode, **options)


def row(world: int, uav: int) -> int:
    return world * N + uav


@pytest.mark.parametrize("mode", MODES)
def test_every_row_is_its_uavs(mode: str) -> None:
    """Observation, state, reward and flags of each, over three episodes."""
    torch.manual_seed(0)
    env, whole = PerUavEnv(worlds(mode, 4)), worlds(mode, 4)
    ours, theirs = env.reset(), whole.reset()
    for step in range(3 * H):
        action = torch.randn(B * N, env.action_spec.shape[-1])
        ours["action"] = action
        theirs["uav", "action"] = torch.stack(
            [torch.stack([action[row(b, i)] for i in range(N)]) for b in range(B)]
        )
        (ours, after), (theirs, then) = (
            env.step_and_maybe_reset(ours),
            whole.step_and_maybe_reset(theirs),
        )
        for flat, full in ((ours, theirs), (ours["next"], theirs["next"])):
            for b in range(B):
                for i in range(N):
                    seen = full["uav", "observation"]
                    expected = torch.cat([seen[name][b, i] for name in env.leaves])
                    assert torch.equal(flat["observation"][row(b, i)], expected)
                    assert torch.equal(flat["state"][row(b, i)], full["state"][b])
        for b in range(B):
            for i in range(N):
                reward = theirs["next", "uav", "reward"][b, i]
                assert torch.equal(ours["next", "reward"][row(b, i)], reward)
                for flag in ("done", "terminated", "truncated"):
                    assert torch.equal(ours["next", flag][row(b, i)], theirs["next", flag][b])
        assert bool(ours["next", "truncated"].all()) == (step % H == H - 1)
        assert not ours["next", "terminated"].any()
        ours, theirs = after, then
    assert env.env.world.seeds.tolist() == [4 + 3 * B + b for b in range(B)]


@pytest.mark.parametrize("mode", MODES)
def test_specs(mode: str) -> None:
    check_env_specs(PerUavEnv(worlds(mode)), seed=3)
    env = TransformedEnv(PerUavEnv(worlds(mode)))
    env.append_transform(RewardSum(in_keys=["reward"]))
    check_env_specs(env)


def test_leaves_stand_side_by_side_in_the_order_asked_for() -> None:
    env = PerUavEnv(worlds("correction"), ["last_action", "imu", "base_std"])
    assert env.leaves == ("last_action", "imu", "base_std")
    assert env.reset()["observation"].shape == (B * N, 3 + 6 + 3)
    whole = worlds("correction").reset()["uav", "observation"]
    torch.testing.assert_close(env.reset()["observation"][:, :3], torch.zeros(B * N, 3))
    first = PerUavEnv(worlds("correction"), ["imu"]).reset()["observation"]
    assert torch.equal(first, whole["imu"].reshape(B * N, 6))


def test_without_a_wish_the_mode_says_what_is_read() -> None:
    assert PerUavEnv(worlds("correction")).leaves == (
        *("base_std", "fix_mean", "residuals", "last_action"),
    )
    assert PerUavEnv(worlds("displacement")).leaves == ("fix_mean", "fix_share", "last_action")
    every = PerUavEnv(worlds("estimate"))
    assert set(every.leaves) == set(worlds("estimate").reset()["uav", "observation"].keys())


def test_actions_have_the_modes_bounds() -> None:
    spec = PerUavEnv(worlds("displacement")).action_spec
    assert spec.shape == (B * N, 3)
    assert (spec.space.low == -1).all()
    assert (spec.space.high == 1).all()
    whole = worlds("estimate")
    low = PerUavEnv(whole).action_spec.space.low
    assert torch.equal(low, whole.full_action_spec["uav", "action"].space.low.flatten(0, 1))


def reset(env: PerUavEnv, now: TensorDictBase, rows: list[int]) -> TensorDictBase:
    chosen = torch.zeros(B * N, 1, dtype=torch.bool)
    chosen[rows] = True
    return env.reset(now.clone().set("_reset", chosen))


def test_the_uavs_of_a_world_start_anew_together() -> None:
    env = PerUavEnv(worlds("displacement", 4))
    now = env.reset()
    now["action"] = torch.ones(B * N, 3)
    after = env.step(now)["next"]
    for rows in ([0], [row(1, 0), row(1, 1), row(2, 1)]):
        words = "the UAVs of a world start anew together, not one by one"
        with pytest.raises(ValueError, match=words):
            reset(env, after, rows)
    again = reset(env, after, [row(1, 0), row(1, 1)])
    assert env.env.world.seeds.tolist() == [4, 5 + B, 6]
    assert env.env.world.step_index.tolist() == [1, 0, 1]
    fresh = PerUavEnv(worlds("displacement", 4 + B)).reset()
    for r in range(B * N):
        expected = fresh if r // N == 1 else after
        for name in ("observation", "state"):
            torch.testing.assert_close(again[name][r], expected[name][r], atol=1e-5, rtol=1e-5)


def test_a_seed_is_the_first_worlds() -> None:
    env = PerUavEnv(worlds("displacement"))
    env.set_seed(50)
    env.reset()
    assert env.env.world.seeds.tolist() == [50, 51, 52]


@pytest.mark.parametrize("mode", ["displacement", "correction"])
def test_a_collector_flies_a_recurrent_policy(mode: str) -> None:
    """Batches that end within an episode: memory goes on there, and starts anew with a world."""
    env = PerUavEnv(worlds(mode, 7, horizon=12))
    torch.manual_seed(0)
    actor = actor_for(env.mode, hidden=8, recurrent=True)
    with torch.no_grad():
        actor.head.layer.weight[:3] = torch.randn(3, 8)
    options = {"exploration_type": ExplorationType.DETERMINISTIC}
    batches = [batch.clone() for batch in episode_collector(env, policy_of(actor), 4, **options)]
    assert [batch.shape for batch in batches] == [torch.Size([B * N, 4])] * 3
    seen: Any = torch.cat(batches, 1)
    assert torch.equal(seen["is_init"][..., 0], (torch.arange(12) == 0).expand(B * N, 12))
    memory = torch.zeros(1, B * N, 16)
    for step in range(12):
        with torch.no_grad():
            action, memory = actor.act(seen["observation"][None, :, step], memory)
        torch.testing.assert_close(seen["action"][:, step], action[0], atol=1e-5, rtol=1e-4)
    assert seen["action"].std() > 0.05
    assert (seen["next", "reward"] < 0).all()


def test_wrong_views_are_named() -> None:
    with pytest.raises(ValueError, match="UAVs that fail do not fit rows of one UAV each"):
        PerUavEnv(worlds("displacement", failure_rate=0.5))
    with pytest.raises(ValueError, match=r"there is no leaf 'fix'; known: .*fix_mean"):
        PerUavEnv(worlds("displacement"), ["fix"])


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (torch.zeros(B * N, 9), f"actions of shape ({B}, {N}, 9) do not fit: ({B}, {N}, 3)"),
        (torch.full((B * N, 3), torch.nan), "the action of uav_0 in world 0 holds NaN or infinity"),
    ],
)
def test_wrong_actions_are_named(action: torch.Tensor, words: str) -> None:
    env = PerUavEnv(worlds("displacement"))
    now = env.reset()
    now["action"] = action
    with pytest.raises(ValueError, match=re.escape(words)):
        env.step(now)
