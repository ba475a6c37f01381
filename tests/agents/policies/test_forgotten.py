"""ParallelPolicy where its reset was forgotten, and where one agent at a time observes."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from agents import make
from agents.policies.adapters import ParallelPolicy
from agents.policies.team import Team
from coloc_env.envs.pettingzoo import env, parallel_env
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario


def indoor(**settings: Any) -> Scenario:
    return make_scenario("indoor-v0", **{"n_uavs": 3, "horizon": 6, **settings})


def policies(scenario: Scenario) -> list[Any]:
    return [
        ParallelPolicy(make("ekf", scenario)),
        ParallelPolicy(make("ekf", scenario), scenario.agents),
        Team(scenario, {"uav_0": "ekf", "uav_1": "dead_reckoning", "uav_2": "ekf"}),
    ]


def episode(
    scenario: Scenario, policy: Any, seed: int, steps: int = 99
) -> list[dict[str, np.ndarray]]:
    """Actions of an episode, or of its first steps; the policy is not reset."""
    made = parallel_env(scenario)
    observations, _ = made.reset(seed=seed)
    taken = []
    while made.agents and len(taken) < steps:
        taken.append(policy({agent: observations[agent] for agent in made.agents}))
        observations, *_ = made.step(taken[-1])
    return taken


def same(one: list[dict[str, np.ndarray]], other: list[dict[str, np.ndarray]]) -> bool:
    return len(one) == len(other) and all(
        a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a)
        for a, b in zip(one, other, strict=True)
    )


@pytest.mark.parametrize("which", range(3))
@pytest.mark.parametrize("settings", [{}, {"message_delay": 2}, {"failure_rate": 0.6}])
@pytest.mark.parametrize("seeds", [(1, 2), (1, 1)])
@pytest.mark.parametrize("stop", [99, 4])
def test_a_new_episode_is_noticed(
    which: int, settings: dict[str, Any], seeds: tuple[int, int], stop: int
) -> None:
    """Another world, and the same again, after a whole episode and after a part."""
    scenario = indoor(**settings)
    expected = episode(scenario, policies(scenario)[which], seeds[1])
    policy = policies(scenario)[which]
    episode(scenario, policy, seeds[0], stop)
    assert same(episode(scenario, policy, seeds[1]), expected)


@pytest.mark.parametrize(
    "settings",
    [
        {"message_loss": 0.9},
        {"message_delay": 3},
        {"failure_rate": 0.9},
        {"comm_radius": 3.0},
        {"landmarks": 0},
        {"n_uavs": 1},
    ],
)
def test_an_episode_that_goes_on_is_not_taken_for_a_new_one(settings: dict[str, Any]) -> None:
    scenario = indoor(**{"horizon": 30, **settings})
    resets = 0

    class Counting(ParallelPolicy):
        def reset(self) -> None:
            nonlocal resets
            resets += 1
            super().reset()

    for seed in range(4):
        policy = Counting(make("ekf", scenario))
        resets = 0
        episode(scenario, policy, seed)
        assert resets == 0


def test_edits_of_observations_do_not_reach_what_a_failed_uav_leaves() -> None:
    scenario = indoor(failure_rate=0.9, horizon=20)

    def run(harm: Callable[[np.ndarray], None]) -> list[dict[str, np.ndarray]]:
        made, policy, taken = parallel_env(scenario), ParallelPolicy(make("ekf", scenario)), []
        observations, _ = made.reset(seed=1)
        while made.agents:
            taken.append(policy({agent: observations[agent] for agent in made.agents}))
            for own in observations.values():
                for leaf in own.values():
                    harm(leaf)
            observations, *_ = made.step(taken[-1])
        return taken

    assert same(run(lambda leaf: leaf.fill(1e6)), run(lambda leaf: None))


def refused(words: str) -> Any:
    return pytest.raises(ValueError, match="^ekf: [^\n]*" + re.escape(words) + "[^\n]*$")


def test_an_aec_loop_is_named() -> None:
    scenario = indoor()
    made = env(scenario)
    made.reset(seed=0)
    for policy in policies(scenario)[:2]:
        with refused("an AEC environment's last() is of one agent"):
            policy(made.last()[0])
    with refused("the episode's first step lacks uav_1"):
        policies(scenario)[1]({"uav_0": made.observe("uav_0")})
    policy = policies(scenario)[0]
    policy({"uav_0": made.observe("uav_0")})
    with refused("uav_1 was not there at the episode's first step, which had uav_0; observations"):
        policy({"uav_1": made.observe("uav_1")})


def test_one_policy_a_uav_acts_in_an_aec_loop() -> None:
    """As it does beside the others in the parallel environment."""
    scenario = indoor()
    expected = episode(scenario, Team(scenario, dict.fromkeys(scenario.agents, "ekf")), 3)
    made = env(scenario)
    made.reset(seed=3)
    own = {a: ParallelPolicy(make("ekf", scenario), [a]) for a in scenario.agents}
    taken: list[dict[str, np.ndarray]] = [{} for _ in expected]
    for k in range(len(expected)):
        for agent in scenario.agents:
            action = own[agent]({agent: made.last()[0]})
            taken[k] |= action
            made.step(action[agent])
    for found, wanted in zip(taken, expected, strict=True):
        for agent in scenario.agents:
            np.testing.assert_allclose(found[agent], wanted[agent], atol=1e-4)
