"""The stable-baselines3 face: PerUavEnv's numbers, SB3's conventions, its algorithms at work."""

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
from tensordict import TensorDictBase

from agents.wrappers.correction import with_base
from coloc_env.envs.sb3 import CoLocVecEnv
from coloc_env.envs.torchrl import CoLocEnv, PerUavEnv
from coloc_env.scenarios import make_scenario

B, N, H = 3, 2, 5
MODES = ("estimate", "displacement", "correction")


def vectors(mode: str = "displacement", seed: int = 0, worlds: int = B, **more: Any) -> CoLocVecEnv:
    options: dict[str, Any] = {"n_uavs": N, "horizon": H, "motion": "random"} | more
    if mode == "correction":
        return with_base(CoLocVecEnv(num_worlds=worlds, seed=seed, **options))
    return CoLocVecEnv(num_worlds=worlds, seed=seed, action=mode, **options)


def rows(mode: str, seed: int = 0) -> PerUavEnv:
    options: dict[str, Any] = {"n_uavs": N, "horizon": H, "motion": "random"}
    if mode == "correction":
        return PerUavEnv(with_base(CoLocEnv(num_envs=B, seed=seed, **options)))
    return PerUavEnv(CoLocEnv(num_envs=B, seed=seed, action=mode, **options))


def zeros(env: CoLocVecEnv) -> NDArray[np.float32]:
    shape: Any = env.action_space.shape
    return np.zeros((env.num_envs, *shape), np.float32)


# ---------------------------------------------------------------- the same numbers


@pytest.mark.parametrize("mode", MODES)
def test_it_is_the_view_of_each_uav(mode: str) -> None:
    """Observations, rewards and ends of three episodes; the last observation of each in infos."""
    ours, theirs = vectors(mode, 4), rows(mode, 4)
    rng = np.random.default_rng(0)
    seen: Any = ours.reset()
    then: TensorDictBase = theirs.reset()
    assert ours.leaves == theirs.leaves
    assert ours.num_envs == B * N
    for step in range(3 * H):
        assert seen.dtype == np.float32
        np.testing.assert_array_equal(seen, then["observation"])
        assert ours.observation_space.contains(seen[0])
        actions = rng.normal(size=(B * N, *ours.action_space.shape)).astype(np.float32)
        seen, rewards, dones, infos = ours.step(actions)
        then["action"] = torch.from_numpy(actions)
        done, then = theirs.step_and_maybe_reset(then)
        np.testing.assert_array_equal(rewards, done["next", "reward"][:, 0])
        np.testing.assert_array_equal(dones, done["next", "done"][:, 0])
        assert (rewards.dtype, dones.dtype) == (np.float32, np.bool_)
        last = step % H == H - 1
        assert dones.tolist() == [last] * B * N
        for i, info in enumerate(infos):
            assert set(info) == ({"TimeLimit.truncated", "terminal_observation"} if last else set())
            if last:
                assert info["TimeLimit.truncated"] is True
                expected = done["next", "observation"][i]
                np.testing.assert_array_equal(info["terminal_observation"], expected)
                assert not np.array_equal(seen[i], expected), "the next episode's first"


def test_what_was_returned_stays_as_it_is() -> None:
    env = vectors()
    kept = [(first := env.reset(), first.copy())]
    seen: Any
    for _ in range(2 * H):
        actions = np.ones_like(zeros(env))
        seen, rewards, dones, infos = env.step(actions)
        actions[:] = 1e6
        kept += [(x, x.copy()) for x in (seen, rewards, dones)]
        kept += [(x, x.copy()) for info in infos for x in info.values() if hasattr(x, "copy")]
    assert all(np.array_equal(x, copy) for x, copy in kept)


# ---------------------------------------------------------------- conventions


def test_seeds_are_the_worlds() -> None:
    env = vectors(seed=4)
    env.reset()
    assert env.get_attr("seed") == [4, 4, 5, 5, 6, 6]
    for _ in range(H):
        env.step(zeros(env))
    assert env.get_attr("seed") == [7, 7, 8, 8, 9, 9]
    env.reset()
    assert env.get_attr("seed") == [10, 10, 11, 11, 12, 12]
    assert env.seed(50) == [50, 50, 51, 51, 52, 52]
    assert env.get_attr("seed")[0] == 10, "at the next reset"
    first = env.reset()
    assert env.get_attr("seed") == [50, 50, 51, 51, 52, 52]
    env.seed(None)
    env.reset()
    assert env.get_attr("seed")[0] == 53
    np.testing.assert_array_equal(vectors(seed=50).reset(), first)


def test_every_uav_has_attributes_and_methods_of_its_own() -> None:
    env = vectors()
    env.reset()
    assert env.get_attr("agent") == ["uav_0", "uav_1"] * B
    assert env.get_attr("world", [0, 3, 5]) == [0, 1, 2]
    assert env.get_attr("uav", 3) == [1]
    assert env.get_attr("scenario", 0) == [env.scenario]
    env.set_attr("role", "leader", [1, 2])
    assert env.get_attr("role", [1, 2]) == ["leader", "leader"]
    assert not hasattr(env.sub_envs[0], "role")
    with pytest.raises(AttributeError):
        env.get_attr("role", 0)
    whole = CoLocEnv(env.scenario, B, seed=0, action="displacement").reset()["state"]
    for i, state in enumerate(env.env_method("state")):
        np.testing.assert_array_equal(state, whole[i // N])
    assert len(env.env_method("state", indices=[2])) == 1
    assert env.env_is_wrapped(Monitor) == [False] * B * N
    assert env.env_is_wrapped(gym.Wrapper, [0, 1]) == [False, False]


def test_the_first_world_is_drawn() -> None:
    env = vectors(render_mode="rgb_array")
    assert env.render_mode == "rgb_array"
    env.reset()
    pictures: list[Any] = []
    for _ in range(2):
        env.step(zeros(env))
        pictures.append(env.render())
    for picture in pictures:
        assert picture is not None
        assert picture.dtype == np.uint8
        assert picture.ndim == 3
        assert picture.std() > 0
    assert not np.array_equal(*pictures)
    env.close()
    blind = vectors()
    blind.reset()
    assert blind.render_mode is None
    with pytest.warns(UserWarning, match="no `render_mode` was passed"):
        assert blind.render() is None


def test_spaces_hold_what_is_seen_and_done() -> None:
    for mode in MODES:
        env = vectors(mode)
        space = env.action_space
        assert isinstance(space, gym.spaces.Box)
        assert space.shape == ((9,) if mode == "estimate" else (3,))
        assert space.dtype == np.float32
        seen = env.reset()
        assert env.observation_space.shape == seen.shape[1:]
        env.step(np.stack([space.sample() for _ in range(env.num_envs)]))
    chosen = vectors(leaves=["last_action", "imu"])
    assert chosen.leaves == ("last_action", "imu")
    space = chosen.observation_space
    assert isinstance(space, gym.spaces.Box)
    assert space.low.tolist()[:3] == [-1.0] * 3
    assert (chosen.reset()[:, :3] == 0).all()


def test_wrong_use_is_named() -> None:
    for text, words in (
        ("human", "render_mode='human' is not allowed: None, rgb_array"),
        ("ansi", "render_mode='ansi' is not allowed: None, rgb_array"),
    ):
        with pytest.raises(ValueError, match=re.escape(words)):
            vectors(render_mode=text)
    with pytest.raises(ValueError, match="UAVs that fail do not fit rows of one UAV each"):
        vectors(failure_rate=0.5)
    with pytest.raises(ValueError, match="there is no leaf 'gps'; known: imu, landmarks"):
        vectors(leaves=["gps"])
    with pytest.raises(ValueError, match="overrides go with a scenario's id"):
        CoLocVecEnv(make_scenario("indoor-v0"), n_uavs=2)
    with pytest.raises(ValueError, match="batch_size=0 is not allowed"):
        CoLocVecEnv(num_worlds=0)
    env = vectors(render_mode="rgb_array")
    uses: list[Callable[[], Any]] = [lambda: env.step(zeros(env)), env.render]
    for use in (*uses, lambda: env.env_method("state")):
        with pytest.raises(ValueError, match=re.escape("indoor-v0: call reset() first")):
            use()
    env.reset()
    needed = "indoor-v0: real numbers of shape (6, 3) are needed, each row displacement in m within"
    wrong: np.ndarray
    for wrong in (np.zeros((6, 9)), np.zeros((3, 3)), np.zeros((6, 3), complex), np.array("six")):
        with pytest.raises(ValueError, match=re.escape(needed)) as error:
            env.step(wrong)
        assert str(error.value).endswith(f"got {wrong.dtype} of shape {wrong.shape}")
    for value in (np.nan, np.inf, 1e200):
        wrong = np.zeros((6, 3))
        wrong[4, 1] = value
        words = (
            "indoor-v0: the action of uav_0 in world 2 holds NaN or infinity; (3,) finite numbers"
        )
        with pytest.raises(ValueError, match=re.escape(words)):
            env.step(wrong)


# ---------------------------------------------------------------- algorithms


def test_a_monitor_counts_whole_episodes() -> None:
    env = VecMonitor(vectors())
    env.reset()
    total = np.zeros(B * N)
    for _ in range(H):
        _, rewards, _, infos = env.step(np.zeros((B * N, 3), np.float32))
        total += rewards
    assert [info["episode"]["l"] for info in infos] == [H] * B * N
    found = [info["episode"]["r"] for info in infos]
    np.testing.assert_allclose(found, total, atol=1e-5)


def algorithm(name: str, env: VecNormalize) -> BaseAlgorithm:
    common: dict[str, Any] = {"policy_kwargs": {"net_arch": [16]}, "seed": 0, "device": "cpu"}
    if name == "ppo":
        return PPO("MlpPolicy", env, n_steps=10, batch_size=60, n_epochs=2, **common)
    return SAC("MlpPolicy", env, learning_starts=60, train_freq=4, batch_size=32, **common)


@pytest.mark.parametrize("name", ["ppo", "sac"])
@pytest.mark.parametrize("mode", ["displacement", "correction"])
def test_algorithms_run_and_come_back_from_their_files(
    name: str, mode: str, tmp_path: Path
) -> None:
    """Through VecNormalize, scored in worlds of their own by EvalCallback."""
    env = VecNormalize(vectors(mode))
    scoring = VecNormalize(VecMonitor(vectors(mode, 1000)), training=False, norm_reward=False)
    model = algorithm(name, env)
    before = [p.detach().clone() for p in model.policy.parameters()]
    callback = EvalCallback(
        scoring,
        n_eval_episodes=6,
        eval_freq=20,
        best_model_save_path=str(tmp_path),
        log_path=str(tmp_path),
        verbose=0,
    )
    model.learn(240, callback=callback)
    assert model.num_timesteps == 240
    assert any(
        not torch.equal(p, q) for p, q in zip(model.policy.parameters(), before, strict=True)
    )
    scores = np.load(tmp_path / "evaluations.npz")
    assert scores["timesteps"].tolist() == [120, 240]
    assert (scores["ep_lengths"] == H).all()
    assert (scores["results"] < 0).all()
    assert (tmp_path / "best_model.zip").exists()
    model.save(tmp_path / "model")
    env.save(str(tmp_path / "normal.pkl"))
    again = type(model).load(tmp_path / "model", device="cpu")
    seen = VecNormalize.load(str(tmp_path / "normal.pkl"), vectors(mode, 30))
    same = vectors(mode, 30)
    seen.training = False
    ours: Any = env.normalize_obs(same.reset())
    theirs: Any = seen.reset()
    np.testing.assert_array_equal(ours, theirs)
    for _ in range(2 * H):
        expected, _ = model.predict(ours, deterministic=True)
        found, _ = again.predict(theirs, deterministic=True)
        np.testing.assert_array_equal(expected, found)
        after: Any = same.step(expected)[0]
        ours = env.normalize_obs(after)
        theirs = seen.step(found)[0]


class Rollout(BaseCallback):
    """Keeps the environments' rewards and what SB3 makes of them."""

    def __init__(self) -> None:
        super().__init__()
        self.rewards: list[NDArray] = []
        self.returns = np.zeros(0)

    def _on_step(self) -> bool:
        self.rewards.append(self.locals["rewards"].copy())
        return True

    def _on_rollout_end(self) -> None:
        self.returns = self.locals["rollout_buffer"].returns.copy()


@pytest.mark.parametrize("gamma", [0.0, 0.9])
def test_the_horizon_bootstraps_in_sb3(gamma: float) -> None:
    """Truncation is no end: with a critic that always says v, the return there is r + γ v."""
    value = 7.0
    env = vectors()
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=2 * H,
        batch_size=60,
        gamma=gamma,
        gae_lambda=1.0,
        policy_kwargs={"net_arch": [8]},
        device="cpu",
    )
    policy: Any = model.policy
    with torch.no_grad():
        policy.value_net.weight.zero_()
        policy.value_net.bias.fill_(value)
    kept = Rollout()
    model.learn(1, callback=kept)  # collects one rollout of two episodes
    rewards, returns = np.stack(kept.rewards), kept.returns
    assert rewards.shape == returns.shape == (2 * H, B * N)
    expected = np.empty_like(rewards, dtype=np.float64)
    for t in reversed(range(2 * H)):
        last = t % H == H - 1
        after = np.full(B * N, value) if last else expected[t + 1]
        expected[t] = rewards[t] + gamma * after
    np.testing.assert_allclose(returns, expected, atol=1e-4)
    if gamma:
        assert (np.abs(returns[H - 1] - rewards[H - 1]) > 6).all()


def test_sac_learns_beyond_the_horizon() -> None:
    """Its replay buffer knows that a truncated step is no end."""
    env = vectors()
    model = SAC("MlpPolicy", env, buffer_size=600, learning_starts=1000, device="cpu")
    model.learn(2 * H * B * N)
    buffer: Any = model.replay_buffer
    ends = np.arange(2 * H) % H == H - 1
    np.testing.assert_array_equal(buffer.dones[: 2 * H].astype(bool), np.tile(ends, (B * N, 1)).T)
    np.testing.assert_array_equal(buffer.timeouts[: 2 * H], buffer.dones[: 2 * H])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sample = buffer.sample(200)
    assert float(sample.dones.sum()) == 0
