"""Localization in the loop of other people's tasks."""

import importlib
import math

import numpy as np
import pytest
import torch
import vmas
from mpe2 import simple_spread_v3
from pettingzoo.test import parallel_api_test
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from agents.wrappers import adapters
from agents.wrappers.adapter import Adapter
from agents.wrappers.entries import Own, cast_rays
from agents.wrappers.localization import Localization
from agents.wrappers.localized import Localized
from agents.wrappers.localized_torchrl import LocalizedTransform
from agents.wrappers.localized_vmas import localized_vmas

PERFECT = {
    "anchors": 4,
    "uwb": False,
    "uwb_std": 1e-3,
    "ins_std": 1e-3,
    "ins_bias": 0.0,
    "prior_std": 0.01,
}
USELESS = {"anchors": 0, "uwb": False, "ins_std": 1e6, "prior": "uniform"}


def spread(**settings):
    inner = simple_spread_v3.parallel_env(max_cycles=10)
    return Localized(inner, adapters.simple_spread, **settings)


def scenario(name: str):
    return importlib.import_module(f"vmas.scenarios.{name}").Scenario()


def still(env):
    return {agent: np.zeros(env.action_space(agent).shape, int) for agent in env.agents}


# ------------------------------------------------------------------ PettingZoo


def test_pettingzoo_accepts_it() -> None:
    parallel_api_test(spread(std=True), num_cycles=30)


def test_good_sensors_show_the_truth() -> None:
    """Every number of every observation, at every step, but what perfect sensors leave over."""
    env, inner = spread(**PERFECT), simple_spread_v3.parallel_env(max_cycles=10)
    seen, _ = env.reset(seed=1)
    truth, _ = inner.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(10):
        for agent, expected in truth.items():
            np.testing.assert_allclose(seen[agent][2:], expected[2:], atol=2e-3)
        actions = {agent: int(rng.integers(5)) for agent in inner.agents}
        seen, rewards, *_ = env.step(actions)
        truth, expected_rewards, *_ = inner.step(actions)
        assert rewards == expected_rewards


def test_useless_sensors_leave_nothing_of_the_truth() -> None:
    """Agents that are elsewhere, among the same landmarks, see the same."""
    env = spread(**USELESS)

    def seen(shift: float) -> dict[str, np.ndarray]:
        env.reset(seed=1)
        for agent in env.unwrapped.world.agents:
            agent.state.p_pos = agent.state.p_pos * 0.2 + shift
        env.team.restart(env.task.places(env.env), 5)
        return env.step(still(env))[0]

    one, other = seen(0.3), seen(-0.5)
    for agent, observation in one.items():
        np.testing.assert_allclose(observation[2:], other[agent][2:], atol=1e-6)


def test_same_seed_same_episode() -> None:
    def episode(env) -> list[np.ndarray]:
        seen = [env.reset(seed=4)[0]]
        while env.agents:
            seen.append(env.step(still(env))[0])
        return [np.stack(list(one.values())) for one in seen if one]

    env = spread(nlos=0.3)
    first, again, fresh = episode(env), episode(env), episode(spread(nlos=0.3))
    for a, b, c in zip(first, again, fresh, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)


def test_noise_differs_from_episode_to_episode() -> None:
    env = spread()
    env.reset(seed=4)
    first = env.team.error.clone()
    env.reset()
    assert not torch.equal(first, env.team.error)


def test_std_is_that_of_the_errors() -> None:
    """The errors of many worlds, in units of the standard deviation, squared: two on average."""
    env, found = spread(std=True, prior_std=3.0), []
    for seed in range(16):
        env.reset(seed=seed)
        for _ in range(3):
            seen, _, _, _, infos = env.step(still(env))
        for agent in seen:
            variance = np.square(10.0 * seen[agent][-2:]).mean()
            found.append(infos[agent]["localization_error"] ** 2 / variance)
    assert np.mean(found) == pytest.approx(2.0, rel=0.35)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"localizer": "nothing"}, "nothing"),
        ({"anchor": 4}, "anchors"),
        ({"nlos": 2.0}, "nlos"),
        ({"anchors": 9}, "anchors"),
    ],
)
def test_what_does_not_fit_is_refused_at_once(settings, words) -> None:
    with pytest.raises(ValueError, match=words):
        spread(**settings)


def test_entries_must_fit() -> None:
    task = Adapter(
        adapters.simple_spread.positions, lambda env, i: [Own(slice(0, 3))], (-1, -1), (1, 1)
    )
    env = Localized(simple_spread_v3.parallel_env(), task)
    with pytest.raises(ValueError, match=r"agent 0 has 2 numbers.*18 is 3"):
        env.reset(seed=1)


def test_positions_must_be_finite() -> None:
    task = Adapter(lambda env: np.full((3, 2), np.nan), lambda env, i: [], (-1, -1), (1, 1))
    with pytest.raises(ValueError, match="finite numbers"):
        Localized(simple_spread_v3.parallel_env(), task).reset(seed=1)


# ------------------------------------------------------------------ what others hear


def test_who_is_out_of_reach_is_known_from_what_was_heard_last() -> None:
    """Two agents; the second flies off at 1 unit/s: beyond the radio's reach it is where its last
    message says, moved on."""
    settings = {**PERFECT, "comm_radius": 10.0}
    team = Localization("ekf", 2, (0.0, 0.0), (4.0, 4.0), 10.0, 0.1, **settings)
    path = [torch.tensor([[[1.0, 1.0], [1.5 + 0.1 * k, 1.0]]]) for k in range(12)]
    team.restart(path[0], 3)
    heard = []
    for places in path[1:]:
        team.move(places)
        heard.append(team.heard[0, 0, 1, 0].item())
    expected = [1.5 + 0.1 * k for k in range(1, 12)]
    np.testing.assert_allclose(heard, expected, atol=2e-2)  # a steady flight is foreseen
    team.move(path[-1] + torch.tensor([0.0, 1.0]))  # not heard: it goes on as it did
    assert team.heard[0, 0, 1, 1] == pytest.approx(1.0, abs=0.02)


def test_who_was_never_heard_is_in_the_middle() -> None:
    settings = {**PERFECT, "comm_radius": 1.0}
    team = Localization("ekf", 2, (-1.0, 0.0), (3.0, 4.0), 10.0, 0.1, **settings)
    places = torch.tensor([[[0.0, 1.0], [2.0, 1.0]]])
    team.restart(places, 3)
    team.move(places)
    torch.testing.assert_close(team.heard[0, 0, 1], torch.tensor([1.0, 2.0], dtype=torch.float64))


def test_rows_reset_alone_and_leave_the_others_as_they_are() -> None:
    def run(alone: bool) -> Tensor:
        torch.manual_seed(0)
        team = Localization("ekf", 3, (0.0, 0.0), (4.0, 4.0), 10.0, 0.1, 2, nlos=0.2)
        places = 4 * torch.rand(2, 3, 2)
        team.restart(places, [5, 6])
        for k in range(8):
            places = (places + 0.05).clamp(max=4.0)
            team.move(places)
            if alone and k == 3:
                rows = torch.tensor([False, True])
                team.restart(places, [0, 9], rows)
        return torch.cat((team.position[0], team.heard[0].flatten(0, 1)))

    torch.testing.assert_close(run(True), run(False), rtol=0, atol=0)


def test_rays_meet_circles() -> None:
    """A circle of 1 m whose centre is 3 m ahead, seen along the axis and 15° off it."""
    angles = torch.tensor([0.0, math.radians(15.0), math.pi / 2])
    found = cast_rays(
        torch.tensor([[1.0, 2.0]]), angles, torch.tensor([[[4.0, 2.0]]]), torch.tensor([1.0])
    )
    side = 3 * math.sin(math.radians(15.0))
    oblique = 3 * math.cos(math.radians(15.0)) - math.sqrt(1 - side**2)
    assert found[0].tolist() == pytest.approx([2.0, oblique, math.inf])


# ------------------------------------------------------------------ VMAS and TorchRL


@pytest.mark.parametrize(
    ("name", "settings"),
    [("navigation", {"collisions": True, "n_agents": 3}), ("flocking", {"n_agents": 3})],
)
def test_vmas_sees_the_truth_through_good_sensors(name: str, settings) -> None:
    task = getattr(adapters, name)
    localized = localized_vmas(scenario(name), task, **PERFECT)
    env = vmas.make_env(localized, num_envs=4, seed=1, **settings)
    plain = vmas.make_env(scenario(name), num_envs=4, seed=1, **settings)
    for agent, twin in zip(localized.world.agents, plain.scenario.world.agents, strict=True):
        twin.set_pos(agent.state.pos, None)
    for thing, twin in zip(localized.world.landmarks, plain.scenario.world.landmarks, strict=True):
        twin.set_pos(thing.state.pos, None)
    for _ in range(5):
        actions = [torch.full((4, 2), 0.3) for _ in range(3)]
        seen, _, _, infos = env.step(actions)
        truth, *_ = plain.step(actions)
        for own, expected in zip(seen, truth, strict=True):
            torch.testing.assert_close(own[:, :2], expected[:, :2], atol=3e-3, rtol=0)
            torch.testing.assert_close(own[:, 4:], expected[:, 4:], atol=2e-2, rtol=0)
        assert all((info["localization_error"] < 0.05).all() for info in infos)


def test_vmas_environments_reset_alone() -> None:
    localized = localized_vmas(scenario("navigation"), adapters.navigation, nlos=0.2)
    env = vmas.make_env(localized, num_envs=3, seed=1)
    env.step(env.get_random_actions())
    before = localized.team.position.clone()
    env.reset_at(1)
    assert torch.equal(localized.team.position[0], before[0])
    assert not torch.equal(localized.team.position[1], before[1])


def test_torchrl_transform() -> None:
    from torchrl.envs.libs.vmas import VmasEnv

    base = VmasEnv("navigation", num_envs=2, seed=0, collisions=False)
    task = Adapter(
        lambda env: adapters.navigation.positions(env._env.scenario),
        lambda env, i: adapters.navigation.entries(env._env.scenario, i),
        (-1.2, -1.2),
        (1.2, 1.2),
    )
    env = TransformedEnv(base, LocalizedTransform(task, **PERFECT))
    check_env_specs(env)
    rollout = env.rollout(6)
    seen = rollout["next", "agents", "observation"][:, -1, :, :2]
    truth = adapters.navigation.positions(base._env.scenario)
    torch.testing.assert_close(seen, truth, atol=3e-3, rtol=0)
    error = rollout["next", "agents", "info", "localization_error"]
    assert error.shape == (*seen.shape[:1], 6, seen.shape[1], 1)
    assert (error < 0.05).all()
