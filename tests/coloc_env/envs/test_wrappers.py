"""The flat PettingZoo view: the same numbers side by side, in one Box."""

import re
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test
from pettingzoo.utils import parallel_to_aec

from agents.wrappers.correction import with_base
from coloc_env.envs.pettingzoo import CoLocParallelEnv, parallel_env
from coloc_env.envs.sb3 import CoLocVecEnv
from coloc_env.envs.wrappers import Flatten

N, H = 3, 5
MODES = ("estimate", "displacement", "correction")


def plain(mode: str, **more: Any) -> CoLocParallelEnv:
    options: dict[str, Any] = {"n_uavs": N, "horizon": H, "motion": "random"} | more
    if mode == "correction":
        return with_base(parallel_env(**options))
    return parallel_env(action=mode, **options)


@pytest.mark.parametrize("mode", MODES)
def test_leaves_stand_side_by_side(mode: str) -> None:
    """Over an episode; all else is as it was."""
    flat, whole = Flatten(plain(mode)), plain(mode)
    rng = np.random.default_rng(0)
    ours, our_infos = flat.reset(seed=3)
    theirs, infos = whole.reset(seed=3)
    assert our_infos == infos
    while whole.agents:
        assert list(ours) == whole.possible_agents
        for agent, seen in ours.items():
            expected = np.concatenate([theirs[agent][name] for name in flat.leaves])
            np.testing.assert_array_equal(seen, expected)
            assert seen.dtype == np.float32
            assert flat.observation_space(agent).contains(seen)
        np.testing.assert_array_equal(flat.state(), whole.state())
        width = whole.action_space("uav_0").shape
        actions = {a: rng.uniform(-1, 1, width).astype(np.float32) for a in whole.agents}
        ours, *our_rest = flat.step(actions)
        theirs, *rest = whole.step(actions)
        assert our_rest == rest
    assert flat.agents == []


def test_it_is_the_vec_envs_observation() -> None:
    flat, vectors = (
        Flatten(plain("correction")),
        with_base(CoLocVecEnv(n_uavs=N, horizon=H, motion="random", seed=3)),
    )
    np.testing.assert_array_equal(np.stack(list(flat.reset(seed=3)[0].values())), vectors.reset())
    assert flat.leaves == vectors.leaves
    assert flat.observation_space("uav_1") == vectors.observation_space


@pytest.mark.parametrize("mode", MODES)
def test_pettingzoos_own_tests(mode: str, capsys: pytest.CaptureFixture[str]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # a Box is what they want
        parallel_api_test(Flatten(plain(mode)), num_cycles=15)
        parallel_seed_test(lambda: Flatten(plain(mode)))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=UserWarning)
        api_test(parallel_to_aec(Flatten(plain(mode))), num_cycles=20)
        seed_test(lambda: parallel_to_aec(Flatten(plain(mode))))
    assert "Passed API test" in capsys.readouterr().out


def test_spaces_are_the_same_objects_for_all() -> None:
    flat = Flatten(plain("displacement"))
    space = flat.observation_space("uav_0")
    assert isinstance(space, gym.spaces.Box)
    assert all(flat.observation_space(a) is space for a in flat.possible_agents)
    assert set(flat.observation_spaces) == set(flat.possible_agents)
    assert flat.action_space("uav_0").shape == (3,)
    assert flat.metadata["name"] == "indoor-v0"


def test_leaves_are_chosen() -> None:
    flat = Flatten(plain("displacement"), ["last_action", "landmark_fix_mask"])
    assert flat.leaves == ("last_action", "landmark_fix_mask")
    space = flat.observation_space("uav_0")
    assert space.low.tolist() == [-1.0] * 3 + [0.0] * 20
    assert space.high.tolist() == [1.0] * 23
    assert all(seen.shape == (23,) for seen in flat.reset(seed=0)[0].values())
    with pytest.raises(ValueError, match=re.escape("there is no leaf 'fix'; known: imu, landmar")):
        Flatten(plain("displacement"), ["fix"])
    with pytest.raises(ValueError, match="there is no leaf 'fix_mean'"):
        Flatten(plain("estimate"), ["fix_mean"])


def test_a_base_leaves_it_flat() -> None:
    flat = with_base(Flatten(plain("estimate")))
    assert isinstance(flat, Flatten)
    assert flat.leaves == Flatten(plain("correction")).leaves
    chosen = with_base(Flatten(plain("estimate"), ["imu"]))
    assert chosen.leaves == ("imu",)
    assert chosen.action_space("uav_0").shape == (3,)
    assert all(seen.shape == (6,) for seen in chosen.reset(seed=0)[0].values())


def test_uavs_that_fail_are_refused() -> None:
    with pytest.raises(ValueError, match="UAVs that fail do not fit rows of one UAV each"):
        Flatten(plain("displacement", failure_rate=0.1))
