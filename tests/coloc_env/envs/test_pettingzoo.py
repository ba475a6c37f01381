"""The PettingZoo face: its API, what it promises, and that it agrees with the TorchRL face."""

import pickle
import re
import warnings
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pettingzoo
import pytest
import torch
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test
from torchrl.envs import PettingZooWrapper

import coloc_env
from coloc_env.envs.pettingzoo import CoLocParallelEnv, env, parallel_env
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.observation import stack
from coloc_env.scenarios import SCENARIOS, make_scenario
from coloc_env.world import World

INFO_KEYS = ("error", "scored", "episode_rmse", "episode_mean", "episode_max", "seed")
VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "failures": {"failure_rate": 0.8},
    "many": {"n_uavs": 20, "comm_radius": 4.0},
    "anchors and loss": {"anchors": 4, "message_loss": 0.3, "message_delay": 1},
    "uniform prior": {"prior": "uniform", "motion": "random"},
    "aggressive": {"motion": "aggressive", "uwb_delay": 2},
    "one": {"n_uavs": 1},
}
Actions = dict[str, np.ndarray]


def idle(environment: CoLocParallelEnv) -> Actions:
    return {agent: np.zeros(9, np.float32) for agent in environment.agents}


def truth(environment: CoLocParallelEnv) -> Actions:
    """The true position and velocity, from the privileged state."""
    n = len(environment.possible_agents)
    rows = environment.state().reshape(n, -1)
    return {
        agent: np.concatenate((row[:6], np.full(3, -3.0, np.float32)))
        for agent, row in zip(environment.possible_agents, rows, strict=True)
        if agent in environment.agents
    }


@pytest.fixture(autouse=True)
def _loud() -> Any:
    """PettingZoo's tests warn where they mean it."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        warnings.filterwarnings("ignore", message="PettingZoo in TorchRL is tested using")
        yield


@pytest.mark.parametrize("variant", VARIANTS)
def test_pettingzoos_own_tests(variant: str) -> None:
    overrides = {"horizon": 12, **VARIANTS[variant]}
    parallel_api_test(parallel_env(**overrides), num_cycles=60)
    parallel_seed_test(lambda: parallel_env(**overrides))


def test_pettingzoos_own_tests_of_the_aec_form(capsys: pytest.CaptureFixture[str]) -> None:
    with warnings.catch_warnings():
        # They ask for spaces of one Box or Discrete, and warn of a Dict.
        warnings.filterwarnings("ignore", category=UserWarning)
        api_test(env(horizon=8), num_cycles=40)
        api_test(env(horizon=8, failure_rate=0.8), num_cycles=40)
        seed_test(lambda: env(horizon=8))
    assert "Passed API test" in capsys.readouterr().out


@pytest.mark.parametrize("variant", VARIANTS)
def test_observations_states_and_samples_lie_in_their_spaces(variant: str) -> None:
    environment = parallel_env(horizon=30, **VARIANTS[variant])
    observations, _ = environment.reset(seed=1)
    while environment.agents:
        for agent, observation in observations.items():
            space = environment.observation_space(agent)
            assert space.contains(observation), agent
            for leaf in observation.values():
                assert leaf.dtype == np.float32
                assert leaf.ndim == 1
        assert environment.state_space.contains(environment.state())
        actions = truth(environment)
        assert all(environment.action_space(a).contains(x) for a, x in actions.items())
        observations, *_ = environment.step(actions)
    assert environment.state_space.contains(environment.state())


def test_spaces_are_the_same_objects_for_all() -> None:
    environment = parallel_env()
    spaces = {id(environment.observation_space(a)) for a in environment.possible_agents}
    assert spaces == {id(environment.observation_space("uav_0"))}
    assert len({id(environment.action_space(a)) for a in environment.possible_agents}) == 1
    assert isinstance(environment.action_space("uav_0"), gym.spaces.Box)
    assert np.isfinite(environment.state_space.low).all()
    assert np.isfinite(environment.state_space.high).all()
    for mask in ("landmark_mask", "range_mask", "links", "message_mask"):
        box = environment.observation_space("uav_0")[mask]
        assert isinstance(box, gym.spaces.Box)
        assert (box.low == 0).all()
        assert (box.high == 1).all()


def test_a_sensor_the_scenario_lacks_has_no_leaf() -> None:
    full = {"imu", "landmarks", "landmark_mask", "ranges", "range_mask", "links", "messages"}
    full |= {"message_mask", "landmark_map", "prior"}
    assert set(parallel_env().observation_space("uav_0")) == full
    bare = parallel_env(imu=False, landmarks=0, uwb=False).observation_space("uav_0")
    assert set(bare) == {"links", "messages", "message_mask", "prior"}


def test_the_true_position_earns_exactly_zero() -> None:
    environment = parallel_env(horizon=10, motion="aggressive")
    environment.reset(seed=0)
    while environment.agents:
        _, rewards, _, _, infos = environment.step(truth(environment))
        assert set(rewards.values()) == {0.0}
        assert all(info["error"] == 0.0 for info in infos.values())


def test_the_horizon_truncates_everybody_at_once() -> None:
    environment = parallel_env(horizon=3)
    environment.reset(seed=0)
    for k in range(3):
        _, _, terminations, truncations, _ = environment.step(idle(environment))
        assert set(terminations.values()) == {False}
        assert set(truncations.values()) == {k == 2}
    assert environment.agents == []
    with pytest.raises(ValueError, match=re.escape("the episode is over; call reset() first")):
        environment.step({})


def test_a_failed_uav_terminates_once_and_leaves() -> None:
    environment = parallel_env(horizon=20, failure_rate=1.0)
    environment.reset(seed=2)
    ended: dict[str, int] = {}
    while environment.agents:
        acting = list(environment.agents)
        observations, rewards, terminations, truncations, infos = environment.step(
            idle(environment)
        )
        for brought in (observations, rewards, terminations, truncations, infos):
            assert list(brought) == acting
        for agent in acting:
            assert not (terminations[agent] and truncations[agent])
            if terminations[agent]:
                ended[agent] = ended.get(agent, 0) + 1
        gone = [a for a in acting if terminations[a]]
        assert environment.agents == [a for a in acting if a not in gone]
        for listener in observations.values():
            for agent in ended:
                slot = environment.possible_agents.index(agent)
                assert listener["links"][slot] == 0
                assert listener["range_mask"][slot] == 0
                assert listener["message_mask"][slot] == 0
                assert (listener["messages"][9 * slot : 9 * slot + 9] == 0).all()
    assert ended == dict.fromkeys(environment.possible_agents, 1)


def test_a_uav_that_fails_at_the_horizon_terminates() -> None:
    scenario = replace(make_scenario("indoor-v0", n_uavs=3, horizon=2), failures=((1, 2),))
    environment = parallel_env(scenario)
    environment.reset(seed=0)
    environment.step(idle(environment))
    _, _, terminations, truncations, _ = environment.step(idle(environment))
    assert terminations == {"uav_0": False, "uav_1": True, "uav_2": False}
    assert truncations == {"uav_0": True, "uav_1": False, "uav_2": True}


def test_infos_are_flat_numeric_and_always_have_the_same_keys() -> None:
    environment = parallel_env(horizon=15, failure_rate=0.5)
    _, infos = environment.reset(seed=0)
    errors: dict[str, list[float]] = {a: [] for a in environment.agents}
    last: dict[str, dict[str, float]] = {}
    while True:
        for agent, info in infos.items():
            assert tuple(info) == INFO_KEYS
            assert all(type(value) is float for key, value in info.items() if key != "seed")
            assert info["seed"] == 0
            last[agent] = info
        if not environment.agents:
            break
        *_, infos = environment.step(idle(environment))
        for agent, info in infos.items():
            errors[agent].append(info["error"])
            assert info["scored"] == 1.0
    for agent, info in last.items():
        values = np.array(errors[agent])
        np.testing.assert_allclose(info["episode_rmse"], np.sqrt((values**2).mean()), rtol=1e-5)
        np.testing.assert_allclose(info["episode_mean"], values.mean(), rtol=1e-6)
        assert info["episode_max"] == values.max()


def test_observations_and_arrays_are_nobodys_but_the_agents() -> None:
    environment = parallel_env(horizon=40, n_uavs=3)
    observations, _ = environment.reset(seed=0)
    leaves = [leaf for seen in observations.values() for leaf in seen.values()]
    for i, first in enumerate(leaves):
        for second in leaves[:i]:
            assert not np.shares_memory(first, second)
    kept = []
    for _ in range(2):
        while environment.agents:
            kept += [(x, x.copy()) for seen in observations.values() for x in seen.values()]
            actions = truth(environment)
            state = environment.state()
            kept.append((state, state.copy()))
            observations, *_ = environment.step(actions)
            for action in actions.values():
                action[:] = 1e6
        observations, _ = environment.reset()
    assert all(np.array_equal(x, copy) for x, copy in kept)


def test_it_is_the_world_of_its_seed() -> None:
    environment = parallel_env(horizon=10, nlos=0.3)
    world = World(make_scenario("indoor-v0", horizon=10, nlos=0.3), 3)
    observations, _ = environment.reset(seed=8)
    expected = world.reset([7, 8, 9])
    rng = np.random.default_rng(0)
    for _ in range(10):
        together = stack(observations.values())
        assert together.leaves.keys() == expected.leaves.keys()
        for name, leaf in together.leaves.items():
            assert torch.equal(leaf[0], expected[name][1]), name
        assert np.array_equal(environment.state(), world.state()[1].numpy())
        actions = rng.normal(size=(6, 9)).astype(np.float32)
        observations, rewards, *_ = environment.step(
            dict(zip(environment.agents, actions, strict=True))
        )
        step = world.step(torch.from_numpy(actions).expand(3, -1, -1))
        assert list(rewards.values()) == step.reward[1].tolist()
        expected = world.observation()


@pytest.mark.parametrize("moment", [None, 0, 4])
@pytest.mark.parametrize("form", [parallel_env, env])
def test_a_pickled_environment_goes_on_alike(moment: int | None, form: Any) -> None:
    original = form(horizon=9, failure_rate=0.4, motion="random_velocity")
    if moment is not None:
        original.reset(seed=3)
        for _ in range(moment):
            advance(original)
    copy = pickle.loads(pickle.dumps(original))
    if moment is None:
        original.reset(seed=3)
        copy.reset(seed=3)
    while original.agents:
        assert repr(advance(original)) == repr(advance(copy))
        assert original.agents == copy.agents
    assert repr(original.reset()) == repr(copy.reset())


def advance(environment: Any) -> Any:
    """One step (of all agents, or of one), and what it brings."""
    if isinstance(environment, CoLocParallelEnv):
        return environment.step(idle(environment))
    brought = environment.last()
    over = environment.terminations[environment.agent_selection]
    over = over or environment.truncations[environment.agent_selection]
    environment.step(None if over else np.zeros(9, np.float32))
    return brought


def test_wrong_actions_are_named() -> None:
    environment = parallel_env(n_uavs=3)
    with pytest.raises(ValueError, match=re.escape("call reset() first")):
        environment.step({})
    environment.reset(seed=0)
    good = idle(environment)

    def refused(actions: Actions, words: str) -> None:
        before = environment.state()
        with pytest.raises(ValueError, match=re.escape(words)) as caught:
            environment.step(actions)
        assert str(caught.value).startswith("indoor-v0: ")
        assert "\n" not in str(caught.value)
        assert np.array_equal(environment.state(), before)

    refused({}, "no action for uav_0; acting now: uav_0, uav_1, uav_2")
    refused({a: good[a] for a in ("uav_0", "uav_2")}, "no action for uav_1")
    refused({**good, "uav_7": good["uav_0"]}, "there is no agent 'uav_7'; acting now: uav_0, uav_1")
    for wrong, words in (
        (
            np.zeros(8, np.float32),
            "the action of uav_1 has shape (8,); (9,) finite numbers are needed",
        ),
        (
            np.zeros((9, 1), np.float32),
            "the action of uav_1 has shape (9, 1); (9,) finite numbers are needed",
        ),
        (np.float32(0.0), "the action of uav_1 has shape (); (9,) finite numbers are needed"),
        (np.full(9, np.nan), "the action of uav_1 holds NaN or infinity"),
        (np.full(9, -np.inf), "the action of uav_1 holds NaN or infinity"),
        (np.array(["x"] * 9), "the action of uav_1 is not made of real numbers"),
        (None, "the action of uav_1 is not made of real numbers"),
    ):
        refused({**good, "uav_1": wrong}, words)  # type: ignore[dict-item]


def test_actions_of_failed_uavs_are_ignored() -> None:
    environment, other = (parallel_env(horizon=30, failure_rate=0.9) for _ in range(2))
    every = {agent: np.zeros(9, np.float32) for agent in environment.possible_agents}
    environment.reset(seed=0)
    other.reset(seed=0)
    while environment.agents:
        loud = every | {a: np.full(9, np.nan) for a in every if a not in environment.agents}
        assert repr(environment.step(loud)) == repr(other.step(idle(other)))


def test_lists_and_doubles_are_actions_too() -> None:
    environment = parallel_env(n_uavs=2)
    environment.reset(seed=0)
    rewards = environment.step({"uav_0": [0.0] * 9, "uav_1": np.zeros(9)})[1]  # type: ignore[dict-item]
    environment.reset(seed=0)
    assert environment.step(idle(environment))[1] == rewards


def test_render_modes_are_checked() -> None:
    with pytest.raises(ValueError, match="render_mode='ansi' is not allowed: None, human, rgb_arr"):
        parallel_env(render_mode="ansi")
    environment = parallel_env()
    environment.reset(seed=0)
    with pytest.raises(ValueError, match="needs a render_mode: human or rgb_array"):
        environment.render()
    drawn = parallel_env(render_mode="rgb_array", horizon=4)
    with pytest.raises(ValueError, match=re.escape("call reset() first")):
        drawn.render()
    for _ in range(2):
        drawn.reset(seed=0)
        drawn.step(idle(drawn))
        picture = drawn.render()
        assert picture is not None
        assert picture.ndim == 3
        assert picture.dtype == np.uint8
        drawn.close()


def test_a_scenario_or_its_id() -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2)
    assert parallel_env(scenario).possible_agents == ["uav_0", "uav_1"]
    with pytest.raises(ValueError, match="overrides go with a scenario's id"):
        parallel_env(scenario, n_uavs=3)
    with pytest.raises(ValueError, match=r"unknown scenario 'indor-v0'.*did you mean 'indoor-v0'"):
        parallel_env("indor-v0")
    with pytest.raises(ValueError, match=r"indoor-v0: unknown option 'n_uav'.*mean 'n_uavs'"):
        parallel_env(n_uav=3)


def test_state_needs_a_reset() -> None:
    with pytest.raises(ValueError, match=re.escape("call reset() first")):
        parallel_env().state()


@pytest.mark.skipif(not hasattr(pettingzoo, "make"), reason="PettingZoo before 1.27")
def test_ids_are_registered() -> None:
    made = pettingzoo.make("parallel", "coloc/indoor-v0", n_uavs=2)
    assert isinstance(made, CoLocParallelEnv)
    assert made.metadata["name"] == "indoor-v0"
    assert isinstance(pettingzoo.make("aec", "coloc/indoor-v0"), pettingzoo.AECEnv)
    for name in SCENARIOS:
        assert f"coloc/{name}" in pettingzoo.parallel_registry
        assert f"coloc/{name}" in pettingzoo.aec_registry


def test_the_package_offers_its_parts_by_name() -> None:
    assert coloc_env.parallel_env is parallel_env
    assert coloc_env.CoLocEnv is CoLocEnv
    assert coloc_env.World is World
    assert set(coloc_env.__all__) >= {"env", "make_scenario", "parallel_env"}
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = coloc_env.nothing


@pytest.mark.parametrize("variant", ["plain", "anchors and loss", "failures"])
def test_pettingzoo_wrapper_and_colocenv_agree(variant: str) -> None:
    """The same worlds, step by step, over several episodes by auto-reset."""
    overrides = {"horizon": 7, "n_uavs": 3, **VARIANTS[variant]}
    wrapped = PettingZooWrapper(parallel_env(**overrides), use_mask=True, done_on_any=False)
    native = CoLocEnv(num_envs=1, seed=5, **overrides)
    generator = torch.Generator().manual_seed(0)
    a, b = wrapped.reset(seed=5), native.reset()
    for _ in range(25):
        action = torch.randn(3, 9, generator=generator)
        a["uav", "action"], b["uav", "action"] = action, action.unsqueeze(0)
        a, a_next = wrapped.step_and_maybe_reset(a)
        b, b_next = native.step_and_maybe_reset(b)
        alive = b["uav", "mask"][0]
        assert torch.equal(a["uav", "mask"], alive)
        for name in b["uav", "observation"].keys():  # noqa: SIM118
            got, expected = a["uav", "observation", name], b["uav", "observation", name][0]
            assert torch.equal(got[alive], expected[alive]), name
        assert torch.equal(a["next", "uav", "reward"][alive], b["next", "uav", "reward"][0][alive])
        for name in ("done", "terminated", "truncated"):
            assert torch.equal(a["next", name], b["next", name][0]), name
        a, b = a_next, b_next
