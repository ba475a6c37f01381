"""Mixed teams, and one learner among localizers as a Gymnasium environment."""

import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from agents import make
from agents.policies.adapters import ParallelPolicy
from agents.policies.team import Team
from agents.wrappers.correction import with_base
from agents.wrappers.single_uav import single_uav
from coloc_env.envs.pettingzoo import CoLocParallelEnv, parallel_env
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import AnchorRanging, Ranging

N, H = 3, 6
METHODS = ("ekf:robust=huber", "pf500:particles=40", "mappo:weights=none", "dead_reckoning")
TAGS = (((0.2, 0.1, -0.1), (-0.3, 0.0, 0.1)),) * N
Actions = dict[str, NDArray[np.float32]]


def indoor(**overrides: Any) -> Scenario:
    return make_scenario("indoor-v0", **{"n_uavs": N, "horizon": H, "motion": "random"} | overrides)


def tagged() -> Scenario:
    """UWB lever arms that differ from UAV to UAV."""
    plain = indoor()
    anchors = AnchorRanging(((0.0, 0.0, 0.0), (10.0, 8.0, 4.0)), tags=TAGS)
    sensors = (plain.sensors[0], Ranging(tags=TAGS), anchors)
    return replace(plain, sensors=sensors, believed_sensors=sensors)


def episode(
    scenario: Scenario, act: Callable[[dict], Actions], seed: int = 2
) -> tuple[list[dict], list[Actions], list[dict[str, float]]]:
    """Observations, actions and rewards of each step."""
    env = CoLocParallelEnv(scenario)
    seen, actions, rewards = [], [], []
    observations, _ = env.reset(seed=seed)
    while env.agents:
        present = {a: observations[a] for a in env.agents}
        seen.append(present)
        actions.append(act(present))
        observations, reward, *_ = env.step(actions[-1])
        rewards.append(reward)
    return seen, actions, rewards


def assert_same(ours: Actions, theirs: Actions, agents: list[str]) -> None:
    for agent in agents:
        np.testing.assert_allclose(ours[agent], theirs[agent], atol=1e-5, rtol=1e-5)


# ---------------------------------------------------------------- teams


@pytest.mark.parametrize("method", METHODS)
def test_a_team_of_one_kind_is_its_localizer(method: str) -> None:
    scenario = indoor(nlos=0.3)
    team = Team(scenario, dict.fromkeys(scenario.agents, method))
    policy = ParallelPolicy(make(method, scenario))
    team.reset()
    _, ours, our_rewards = episode(scenario, team)
    _, theirs, rewards = episode(scenario, policy)
    for a, b in zip(ours, theirs, strict=True):
        assert_same(a, b, scenario.agents)
    assert our_rewards == rewards


def test_each_uav_does_as_its_method_does_on_what_it_saw() -> None:
    """The actions of a mixture, found again by whole teams of each kind on its observations."""
    scenario = indoor(nlos=0.3)
    methods = dict(zip(scenario.agents, METHODS, strict=False))
    team = Team(scenario, methods)
    seen, actions, rewards = episode(scenario, team)
    assert len(seen) == H
    for method in METHODS[:N]:
        policy = ParallelPolicy(make(method, scenario))
        mine = [agent for agent, kind in methods.items() if kind == method]
        for observations, found in zip(seen, actions, strict=True):
            assert found.keys() == set(scenario.agents)
            assert_same(found, policy(observations), mine)
    means = [np.mean([reward[agent] for reward in rewards]) for agent in scenario.agents]
    assert len(set(means)) == N


def test_uavs_of_one_method_share_a_localizer() -> None:
    scenario = indoor(n_uavs=4)
    names = ("ekf", "pf500:particles=40", "ekf", "ekf:robust=huber")
    team = Team(scenario, dict(zip(scenario.agents, names, strict=True)))
    assert [policy.agents for policy in team.policies] == [
        ("uav_0", "uav_2"),
        ("uav_1",),
        ("uav_3",),
    ]


def test_a_team_forgets_its_episode() -> None:
    scenario = indoor()
    methods = {"uav_0": "ekf", "uav_1": "pf500:particles=40", "uav_2": "mappo:weights=none"}
    team = Team(scenario, methods)
    first = episode(scenario, team)[1]
    team.reset()
    again = episode(scenario, team)[1]
    for a, b in zip(first, again, strict=True):
        assert all(np.array_equal(a[agent], b[agent]) for agent in scenario.agents)


def test_a_team_may_leave_uavs_to_somebody_else() -> None:
    scenario = indoor()
    team = Team(scenario, {"uav_1": "ekf"})
    env = parallel_env(scenario)
    assert team(env.reset(seed=0)[0]).keys() == {"uav_1"}


def test_who_fails_gets_no_action() -> None:
    scenario = replace(indoor(), failures=((1, 2), (2, 4)))
    team = Team(scenario, {"uav_0": "ekf", "uav_1": "ekf", "uav_2": "pf500:particles=40"})
    _, actions, _ = episode(scenario, team)
    assert [sorted(step) for step in actions] == [
        *([["uav_0", "uav_1", "uav_2"]] * 2),
        *([["uav_0", "uav_2"]] * 2),
        *([["uav_0"]] * 2),
    ]


def refused(words: str) -> Any:
    return pytest.raises(ValueError, match=re.escape(words))


@pytest.mark.parametrize("make_one", [Team, single_uav])
def test_unknown_uavs_and_methods_are_named(make_one: type) -> None:
    scenario = indoor()

    def one(uav: str, method: str) -> Any:
        if make_one is Team:
            return Team(scenario, {uav: method})
        return single_uav(scenario, uav=uav, others=method)

    with refused("there is no 'uav_3' in the team: uav_0, uav_1, uav_2"):
        one("uav_3", "ekf")
    with refused("unknown agent 'efk' (did you mean 'ekf'?); known: "):
        one("uav_0", "efk")
    with refused("ekf: unknown option 'robst' (did you mean 'robust'?)"):
        one("uav_0", "ekf:robst=huber")


@pytest.mark.parametrize("method", ["ekf_joint", "ekf:robust=cross", "ekf:robust=huber+cross"])
def test_a_method_for_whole_teams_does_not_fit_a_mixture(method: str) -> None:
    scenario = indoor()
    name = method.split(":")[0]
    words = f"{name}: the UAVs share what they measured, so one localizer must act for all of them"
    with refused(words):
        Team(scenario, {"uav_0": method, "uav_1": "ekf", "uav_2": "ekf"})
    with refused(words):
        single_uav(scenario, others=method)
    with refused(words):
        single_uav(scenario, base=method)
    team = Team(scenario, dict.fromkeys(scenario.agents, method))
    policy = ParallelPolicy(make(method, scenario))
    seen, actions, _ = episode(scenario, team)
    for observations, found in zip(seen, actions, strict=True):
        assert_same(found, policy(observations), scenario.agents)


def test_lever_arms_of_a_team_do_not_fit_one_uav() -> None:
    words = "ekf: this team's UWB lever arms differ from UAV to UAV, so one localizer must act"
    with refused(words):
        Team(tagged(), {"uav_0": "ekf"})
    with refused(words):
        single_uav(tagged())
    Team(tagged(), dict.fromkeys(tagged().agents, "ekf"))


# ---------------------------------------------------------------- one UAV


@pytest.mark.parametrize("base", ["none", "ekf", "pf500:particles=40"])
@pytest.mark.parametrize("uav", ["uav_0", "uav_2"])
def test_one_learner_sees_and_does_as_in_a_team_of_learners(base: str, uav: str) -> None:
    """The same numbers as its own of a whole team in that mode, where UAVs do not hear each other
    (with corrections of others than nought, what the others say would differ)."""
    scenario = indoor(uwb=False)
    one = single_uav(scenario, uav, others="dead_reckoning", base=base)
    team = parallel_env(scenario)
    team = team.with_action("displacement") if base == "none" else with_base(team, base)
    rng = np.random.default_rng(0)
    seen, info = one.reset(seed=4)
    whole, infos = team.reset(seed=4)
    assert info == infos[uav]
    over = False
    for step in range(H):
        assert not over
        expected = np.concatenate([whole[uav][name] for name in one.leaves])
        np.testing.assert_allclose(seen, expected, atol=1e-5, rtol=1e-5)
        action = rng.uniform(-1.2, 1.2, 3).astype(np.float32)
        seen, reward, terminated, over, info = one.step(action)
        whole, rewards, _, truncated, infos = team.step(dict.fromkeys(team.agents, action))
        assert reward == pytest.approx(rewards[uav], abs=1e-5)
        assert (terminated, over) == (False, truncated[uav]) == (False, step == H - 1)
        assert info == pytest.approx(infos[uav], abs=1e-5)


def test_the_others_are_localized_by_their_method() -> None:
    """An idle learner with a base is one more of that method: all rewards are the team's."""
    scenario = indoor(nlos=0.3)
    _, _, rewards = episode(scenario, ParallelPolicy(make("ekf", scenario)))
    one = single_uav(scenario, "uav_1", others="ekf", base="ekf")
    one.reset(seed=2)
    for expected in rewards:
        found = one.step(np.zeros(3, np.float32))[1]
        assert found == pytest.approx(expected["uav_1"], abs=1e-5)
    assert one.env.world.now.over.all()


@pytest.mark.parametrize("base", ["none", "ekf"])
def test_gymnasiums_and_sb3s_own_checks(base: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for words in (".*render mode.*", ".*is -infinity.*", ".*is infinity.*", ".*`check_env` is"):
            warnings.filterwarnings("ignore", message=words)  # what they mean as hints
        check_env(single_uav(indoor(), base=base, render_mode="rgb_array"))
        sb3_check_env(single_uav(indoor(), base=base), warn=True)


def test_sb3_learns_with_it() -> None:
    env = single_uav(indoor(), base="none")
    model = PPO("MlpPolicy", env, n_steps=18, batch_size=18, n_epochs=1, device="cpu")
    model.learn(36)
    assert model.num_timesteps == 36


def test_a_seed_is_a_world_and_the_next_follows() -> None:
    one, other = single_uav(indoor()), single_uav(indoor())
    first, _ = one.reset(seed=5)
    second, _ = one.reset()
    np.testing.assert_array_equal(other.reset(seed=5)[0], first)
    np.testing.assert_array_equal(other.reset(seed=6)[0], second)
    assert not np.array_equal(first, second)


def test_an_episode_is_its_seed_and_its_actions() -> None:
    one = single_uav(indoor(), others="pf500:particles=40")

    def run() -> list[str]:
        taken = [repr(one.reset(seed=3))]
        return taken + [repr(one.step(np.full(3, 0.3, np.float32))) for _ in range(H)]

    assert run() == run()


def test_spaces_and_leaves() -> None:
    one = single_uav(indoor(), base="none", leaves=["last_action", "imu"])
    assert one.leaves == ("last_action", "imu")
    assert one.observation_space.shape == (9,)
    assert one.action_space.shape == (3,)
    seen, _ = one.reset(seed=0)
    assert one.observation_space.contains(seen)
    seen, *_ = one.step(np.array([0.5, -2.0, 0.0], np.float32))
    assert seen[:3].tolist() == [0.5, -1.0, 0.0]
    with refused("there is no leaf 'gps'; known: "):
        single_uav(indoor(), leaves=["gps"])


def test_a_uav_alone_needs_nobody() -> None:
    one = single_uav(indoor(n_uavs=1), base="ekf")
    one.reset(seed=0)
    errors = [-one.step(np.zeros(3, np.float32))[1] for _ in range(H)]
    _, _, rewards = episode(one.scenario, ParallelPolicy(make("ekf", one.scenario)), 0)
    assert errors == pytest.approx([-step["uav_0"] for step in rewards], abs=1e-5)


def test_wrong_use_is_named() -> None:
    one = single_uav(indoor(), base="none")
    with refused("indoor-v0: call reset() first"):
        one.step(np.zeros(3, np.float32))
    one.reset(seed=0)
    needed = "; (3,) finite numbers are needed with action=displacement: displacement in m within"
    for wrong, words in (
        (np.zeros(9), "has shape (9,)"),
        (np.zeros(2, np.float32), "has shape (2,)"),
        (np.array([0.0, np.nan, 0.0]), "holds NaN or infinity"),
        (np.zeros(3, complex), "is not made of real numbers"),
        (None, "is not made of real numbers"),
    ):
        with refused(f"indoor-v0: the action of uav_0 {words}{needed}"):
            one.step(wrong)
    with refused("unknown agent 'efk'"):
        single_uav(indoor(), base="efk")
    with refused("UAVs that fail do not fit rows of one UAV each"):
        single_uav(indoor(failure_rate=0.5))
    with refused("render_mode='ansi' is not allowed"):
        single_uav(indoor(), render_mode="ansi")


def test_the_scene_is_drawn() -> None:
    one = single_uav(indoor(), render_mode="rgb_array")
    one.reset(seed=0)
    one.step(np.zeros(3, np.float32))
    picture = one.render()
    assert picture.dtype == np.uint8
    assert picture.std() > 0
    one.close()


def test_the_learners_estimate_reaches_the_others() -> None:
    """What it says of itself is what they hear."""
    one = single_uav(indoor(), "uav_0", others="ekf", base="none")
    one.reset(seed=0)
    one.step(np.array([1.0, 0.0, 0.0], np.float32))
    prior = one._observations["uav_0"]["prior"][:3]
    heard = one._observations["uav_1"]["messages"][:9]
    expected = np.concatenate((prior + np.array([1.0, 0.0, 0.0]), np.zeros(6)))
    np.testing.assert_allclose(heard, expected, atol=1e-5)
    assert torch.isfinite(torch.from_numpy(heard)).all()
