"""Swarm filters among anchors, with lever arms and with full motion models."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from torch import Tensor

from agents import make
from agents.models.process import make_process
from agents.stdcl.stdcl import StDcl
from agents.swarm.anchored import AnchoredTeam
from agents.swarm.centres import Centres, centre_distance
from agents.swarm.joint import marginals
from agents.swarm.links import lengths
from agents.swarm.marginals import block_diagonal, range_update, with_marginals
from agents.swarm.navigation import NavigationFilter
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import AnchorRanging, RangeNoise, Ranging
from coloc_env.world import World


def random(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def covariance(*shape: int, seed: int = 0) -> Tensor:
    root = random(*shape, shape[-1], seed=seed)
    return root @ root.mT + 0.1 * torch.eye(shape[-1], dtype=torch.float64)


# ---------------------------------------------------------------- lever arms


def test_centred_solves_the_triangle() -> None:
    unit = torch.nn.functional.normalize(random(40, 3), dim=-1)
    offset, ranges = 0.3 * random(40, 3, seed=1), 1.5 + random(40, seed=2).abs()
    found = centre_distance(ranges, offset, unit)
    for d, r, o, u in zip(found, ranges, offset, unit, strict=True):
        tags = lambda D: float(torch.linalg.vector_norm(D * u + o) - r)  # noqa: B023, E731
        assert float(d) == pytest.approx(brentq(tags, 0.5, 10.0), abs=1e-9)


def exact(scenario: Scenario) -> Scenario:
    """The same without noise."""

    def clean(sensor: Any) -> Any:
        ranges = isinstance(sensor, AnchorRanging | Ranging)
        return replace(sensor, noise=RangeNoise(std=1e-6)) if ranges else sensor

    return replace(scenario, sensors=tuple(map(clean, scenario.sensors)))


def test_links_are_between_centres(tools: SimpleNamespace) -> None:
    scenario = tools.families["tags"]()
    world = World(exact(scenario), 2)
    observation, ranging = world.reset(0), scenario.believed.sensor(Ranging)
    truth = torch.cat((world.truth.position, world.truth.velocity, world.truth.attitude), -1)
    rotation = make_process(scenario.believed).rotation(truth)
    centres = Centres(scenario.believed, ranging)
    links, weight = centres.links(observation, truth[..., :3], rotation)
    anchors = observation["anchor_map"][:, 0].double().unflatten(-1, (-1, 3))
    expected = lengths(torch.cat((truth[..., :3], anchors), 1))
    assert links.distance[links.mask].numpy() == pytest.approx(
        expected[links.mask].numpy(), abs=1e-4
    )
    n, a = 3, anchors.shape[1]
    pairs = ~torch.eye(n, dtype=torch.bool)
    assert (weight[:, :n, :n][:, pairs] == 4).all()  # two tags each
    assert (weight[:, :n, n:] == 2).all()
    assert (weight[:, n:, n:] == 0).all()
    assert torch.equal(links.mask, weight > 0)
    links = centres.with_surveyed(links, anchors)
    assert links.mask.sum() == 2 * ((n + a) * (n + a - 1))  # everybody with everybody
    assert links.distance[links.mask].numpy() == pytest.approx(
        expected[links.mask].numpy(), abs=1e-4
    )


def test_arms_are_noise_where_attitude_is_unknown(tools: SimpleNamespace) -> None:
    scenario = tools.families["tags"]()
    observation = World(scenario, 1).reset(0)
    ranging = scenario.believed.sensor(Ranging)
    _, weight = Centres(scenario.believed, ranging).links(observation, random(1, 3, 3), None)
    arms = torch.tensor(ranging.tags, dtype=torch.float64)
    std, spread = ranging.noise.std, float(arms.square().sum(-1).mean()) / 3
    assert float(weight[0, 0, 1]) == pytest.approx(4 / (1 + 2 * spread / std**2))
    assert float(weight[0, 0, 3]) == pytest.approx(2 / (1 + spread / std**2))


# ---------------------------------------------------------------- navigation filter


def navigation(tools: SimpleNamespace) -> NavigationFilter:
    scenario = tools.linear
    return NavigationFilter(scenario.believed, make_process(scenario.believed))


def test_replacing_the_marginal_keeps_the_conditional_of_the_rest(tools: SimpleNamespace) -> None:
    """If the position found is the posterior of a measurement of it, so is all the rest."""
    p, state, z = covariance(1, 1, 6), random(1, 1, 6), random(1, 1, 3, seed=5)
    noise, h = covariance(3, seed=4), torch.eye(3, 6, dtype=torch.float64)
    gain = p @ h.T @ torch.linalg.inv(h @ p @ h.T + noise)
    x = state + (gain @ (z - state[..., :3]).unsqueeze(-1))[..., 0]
    after = p - gain @ h @ p
    found, kept = navigation(tools).replace_marginal(state, p, x[..., :3], after[..., :3, :3])
    torch.testing.assert_close(found, x, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(kept, after, rtol=1e-8, atol=1e-8)
    found, kept = navigation(tools).update(state, p, z, noise.expand(1, 1, 3, 3))
    torch.testing.assert_close(found, x, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(kept, after, rtol=1e-8, atol=1e-8)


def test_an_equal_position_is_no_measurement(tools: SimpleNamespace) -> None:
    p, state = covariance(1, 2, 6), random(1, 2, 6)
    place = state[..., :3].clone()
    place[0, 1] += 1.0
    found, kept = navigation(tools).update(state, p, place, p[..., :3, :3])
    assert torch.equal(found[0, 0], state[0, 0])
    assert torch.allclose(kept[0, 0], p[0, 0])
    assert (kept[0, 1].diagonal() < p[0, 1].diagonal()).all()


def test_a_range_informs_its_own_direction() -> None:
    place = torch.tensor([[[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]], dtype=torch.float64)
    weight = torch.tensor([[[0.0, 4.0], [4.0, 0.0]]], dtype=torch.float64)
    variance = torch.tensor([[9.0, 0.75]], dtype=torch.float64)
    before = torch.eye(3, dtype=torch.float64).expand(1, 1, 3, 3)
    found = range_update(before, place, weight, variance)[0, 0]
    np.testing.assert_allclose(found.diagonal(), [0.5, 1.0, 1.0])  # 1 / (1 + 1 / (1/4 + 0.75))


def test_joint_covariances_with_given_marginals() -> None:
    whole = covariance(2, 9, seed=1)
    joint, after = whole.view(2, 3, 3, 9), covariance(2, 3, 3, seed=2)
    found = with_marginals(joint, marginals(joint), after)
    torch.testing.assert_close(marginals(found), after, rtol=1e-9, atol=1e-9)
    assert (torch.linalg.eigvalsh(found.reshape(2, 9, 9)) > 0).all()
    noise = covariance(2, 3, 3, seed=3)
    grown = with_marginals(joint, marginals(joint), marginals(joint) + noise)
    alone = torch.block_diag(*noise[0])
    torch.testing.assert_close(grown.reshape(2, 9, 9)[0], whole[0] + alone, rtol=1e-7, atol=1e-7)
    assert torch.equal(block_diagonal(noise).reshape(2, 9, 9)[0], alone)


# ---------------------------------------------------------------- among anchors

LIMITS = {"map": 1.0, "gn": 1.0, "dwmds_st": 2.0, "dwmds_st:confidence=huber": 2.0}


@pytest.mark.parametrize("agent", LIMITS)
def test_strapdown_integration_stays_with_the_anchors(agent: str, tools: SimpleNamespace) -> None:
    """Near the joint EKF, which has every covariance; dead reckoning is lost by then."""
    scenario = tools.families["tags"]()
    errors = {a: tools.score(a, scenario, 2, 60).rmse for a in (agent, "ekf_joint")}
    assert errors[agent] < (1 + LIMITS[agent]) * errors["ekf_joint"]


def test_distances_between_anchors_do_not_calibrate(tools: SimpleNamespace) -> None:
    """Distances between anchors are exact: the error model must not be fitted to them."""
    scenario = tools.families["tags"]()
    localizer, observation = make("dwmds_st", scenario), World(scenario, 1).reset(0)
    first = localizer.reset(observation)
    after, _ = localizer.step(first, observation)
    torch.testing.assert_close(after.swarm.error_sums, first.swarm.error_sums)


@pytest.mark.parametrize("agent", ["dwmds_st", "map", "mds", "dwmds", "vmds", "fcmds", "gn"])
def test_plain_teams_have_the_swarm_filter_itself(agent: str) -> None:
    plain = ("swarm-v0", "campus-v0")
    for scenario in plain:
        assert not isinstance(make(agent, make_scenario(scenario)), AnchoredTeam)
    for scenario in ({"landmarks": 0, "imu": False}, {"landmarks": 0, "anchors": 8}):
        among = make(agent, make_scenario("indoor-v0", **scenario))
        assert isinstance(among, AnchoredTeam)
        assert among.swarm.name == agent


def test_options_reach_the_swarm_filter() -> None:
    among = make("vmds:iterations=7", make_scenario("indoor-v0", landmarks=0, anchors=8))
    assert isinstance(among, AnchoredTeam)
    assert among.swarm.iterations == 7


def test_the_graph_network_refuses_lever_arms(tools: SimpleNamespace) -> None:
    with pytest.raises(ValueError, match="ranges between UAVs, without lever arms, is needed"):
        StDcl(tools.families["tags"]().believed, weights="none")


def test_without_ranges_between_uavs_it_says_so() -> None:
    with pytest.raises(ValueError, match="map: a team with ranges between UAVs is needed"):
        make("map", make_scenario("indoor-v0", landmarks=0, anchors=8, uwb=False))


def test_a_window_of_steps_is_refused() -> None:
    with pytest.raises(ValueError, match="dwmds_st: a window of steps is for teams without fixed"):
        make("dwmds_st:window=3", make_scenario("indoor-v0", landmarks=0, anchors=8))
