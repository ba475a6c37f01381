"""The collaborative Stein particle filter of teams with IMUs."""

import os
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from agents import make
from agents.stein.cspf_inertial import InertialSteinFilter
from coloc_env.datasets import DataError, load
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.world import World
from training.evaluation.team import team_figures


def team(**overrides: Any) -> Scenario:
    return make_scenario("stein3d-v0", imu=True, motion="random", **overrides)


def figures(scenario: Scenario, agent: str, runs: int, steps: int) -> dict[str, Tensor]:
    """Errors of the team's estimates of each other [K, R, N]."""
    localizer, world, each = make(agent, scenario), World(scenario, runs), []
    observation = world.reset(0)
    belief = localizer.reset(observation)
    for _ in range(steps):
        belief, estimate = localizer.step(belief, observation)
        said = localizer.team(belief)
        assert said is not None
        each.append(team_figures(said, world.truth))
        world.advance(estimate.action())
        observation = world.observation()
    return {name: torch.stack([step[name] for step in each]) for name in each[0]}


@pytest.mark.slow
def test_without_noise_the_team_follows_the_truth() -> None:
    """To a few millimetres, which is what matches are off by."""
    exact = team(accel_std=0.0, gyro_std=0.0, relative_pose_noise=(0.003, 0.03), outliers=0.0)
    found = figures(exact, "cspf:particles=1:anneal=0.9:pace=0.8", 2, 90)
    assert found["team_error"][-10:].max() < 0.01
    assert found["team_turn"][-10:].max() < 0.0015


@pytest.mark.slow
def test_velocities_are_those_of_the_world(tools: SimpleNamespace) -> None:
    scenario = team(relative_pose_noise=(0.003, 0.03), outliers=0.0)
    run = tools.play(make("cspf:particles=1:anneal=0.9:pace=0.8", scenario), scenario, [0], 90)
    world = World(scenario, 1)
    world.reset(torch.tensor([0]))
    for estimate in run.estimates[:-1]:
        world.advance(estimate.action())
    found, true = run.estimates[-1].velocity, world.truth.velocity
    apart = (found - found[:, :1]) - (true - true[:, :1])
    assert apart.abs().max() < 0.1


def test_what_is_sent_is_counted(tools: SimpleNamespace) -> None:
    """Ten numbers of an increment, and as many of everybody over each edge, twice a step."""
    scenario = team(n_uavs=4)
    for agent, numbers in (("cspf", 10 + 2 * 3 * 4 * 10), ("cspf:consensus=false", 10)):
        localizer = make(f"{agent}:particles=2", scenario)
        belief = tools.play(localizer, scenario, [0], 3).beliefs[-1]
        sent = localizer.diagnostics(belief)["bytes"]
        torch.testing.assert_close(sent, torch.full((1, 4), 4.0 * numbers))


def test_one_uav_is_the_frame() -> None:
    scenario = team(n_uavs=1)
    filter, observation = make("cspf", scenario), World(scenario).reset([0])
    estimate = filter.step(filter.reset(observation), observation)[1]
    place = observation["reference"][..., :3].double()
    torch.testing.assert_close(estimate.position, place)
    assert estimate.covariance is not None
    assert estimate.covariance.isfinite().all()


def test_a_team_with_imus_has_this_filter_and_no_variant() -> None:
    assert isinstance(make("cspf", team()), InertialSteinFilter)
    with pytest.raises(ValueError, match=r"^cspf: variant is not allowed in a team with IMUs"):
        make("cspf:variant=paper", team())
    with pytest.raises(ValueError, match=r"a team with relative poses, odometry and a reference"):
        make("pf_joint", team())


@pytest.mark.slow
@pytest.mark.parametrize("consensus", [True, False])
def test_flights_of_one_room_find_each_other(consensus: bool) -> None:
    """EuRoC together, a fifth of all matches wrong: with consensus."""
    try:
        load("euroc")
    except DataError as error:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(error))
    flights = make_scenario("replay-stein-euroc-team-v0", span=(0.0, 18.0))
    agent = f"cspf:particles=10:consensus={str(consensus).lower()}"
    found = figures(flights, agent, 3, 170)
    assert bool((found["converged"][-1, :, 0] > 0).all()) is consensus


@pytest.mark.slow
def test_a_centre_with_imu_factors_finds_them_at_once() -> None:
    """GTSAM's window of the whole team, with a fifth of all matches wrong."""
    found = figures(team(), "pose_graph:every=15", 2, 60)
    assert (found["converged"][-1] > 0).all()
