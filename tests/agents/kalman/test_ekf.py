"""The Kalman filters in the room: as good as the bound, as sure as they may be, and robust."""

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from filterpy.kalman import KalmanFilter

from agents import make
from coloc_env.bounds import posterior_bound
from coloc_env.observation import Observation
from coloc_env.scenarios import make_scenario
from coloc_env.world import World
from tests.sampling import crossed

RUNS, STEPS = 10, 150


@cache
def bound() -> float:
    return posterior_bound(make_scenario("indoor-v0"), RUNS, 0, STEPS).rmse


# ---------------------------------------------------------------- as good as can be


def test_with_fixes_alone_it_is_the_textbook_filter() -> None:
    """In a swarm that measures nothing between its UAVs all is linear: filterpy's Kalman filter,
    one for each UAV, with or without fixes."""
    scenario = make_scenario("swarm-v0", n_uavs=4, anchor_share=0.5, anchor_std=8.0)
    own = scenario.sensors[:2]
    scenario = replace(scenario, sensors=own, believed_sensors=own)
    localizer, world = make("ekf", scenario), World(scenario)
    seen = world.reset(0)
    belief, filters = localizer.reset(seen), []
    for prior in seen["prior"][0].double().numpy():
        textbook = KalmanFilter(dim_x=3, dim_z=3, dim_u=3)
        textbook.x, textbook.P = prior[:3, None], 50.0**2 * np.eye(3)
        textbook.F = textbook.B = textbook.H = np.eye(3)
        textbook.Q, textbook.R = (0.5**2 + 2 * 0.3**2) * np.eye(3), 8.0**2 * np.eye(3)
        filters.append(textbook)
    for k in range(30):
        belief, estimate = localizer.step(belief, seen)
        for i, textbook in enumerate(filters):
            if k:
                textbook.predict(u=seen["ins"][0, i].double().numpy()[:, None])
            if i < 2:
                textbook.update(seen["position_fix"][0, i].double().numpy()[:, None])
            assert estimate.position[0, i].numpy() == pytest.approx(textbook.x[:, 0], rel=1e-9)
            assert estimate.covariance[0, i].numpy() == pytest.approx(textbook.P, abs=1e-7)
        world.advance(estimate.action())
        seen = world.observation()


def test_the_swarm_is_localized(tools: SimpleNamespace) -> None:
    """Between dead reckoning and the bound, all but the anchors, who know."""
    scenario = make_scenario("swarm-v0", n_uavs=60, nlos=0.0)
    least = posterior_bound(scenario, 2, steps=40).rmse
    rmse = {}
    for name in ("dead_reckoning", "ekf"):
        localizer, world = make(name, scenario), World(scenario, 2)
        seen, squared = world.reset(0), []
        belief = localizer.reset(seen)
        for _ in range(40):
            belief, estimate = localizer.step(belief, seen)
            error, scored = world.score(estimate.action())
            squared.append(error[scored].square())
            guided = (estimate.position - world.truth.position)[:, :9]
            assert name == "dead_reckoning" or guided.norm(dim=-1).max() < 1.0
            world.advance(estimate.action())
            seen = world.observation()
        rmse[name] = float(torch.cat(squared).mean().sqrt())
    assert least < rmse["ekf"] < 0.25 * rmse["dead_reckoning"]


@pytest.mark.parametrize("name", ["ekf", "ekf_joint"])
def test_the_room_is_localized_to_the_bound(name: str, tools: SimpleNamespace) -> None:
    found = tools.score(name, make_scenario("indoor-v0"), RUNS, STEPS)
    assert 0.95 < found.rmse / bound() < 1.10
    assert tools.consistent(found.nees, 3) > 0.85
    assert 2.7 < found.nees.mean() < 3.3


def test_other_uavs_help(tools: SimpleNamespace) -> None:
    """Where landmarks are few."""
    scenario = make_scenario("indoor-v0", landmarks=5)
    alone = tools.score("ekf:cooperate=false", scenario, 5, 80)
    for name in ("ekf", "ekf_joint"):
        assert tools.score(name, scenario, 5, 80).rmse < 0.9 * alone.rmse


@pytest.mark.parametrize("robust", ["none", "huber", "gate"])
@pytest.mark.parametrize("overrides", [{}, {"imu_bias": True}, {"nlos": 0.3}], ids=str)
def test_alone_every_kalman_filter_is_the_same(
    robust: str, overrides: dict, tools: SimpleNamespace
) -> None:
    """The joint filter of UAVs that do not cooperate is one filter for each."""
    scenario = make_scenario("indoor-v0", **overrides)
    options = f"cooperate=false:robust={robust}:iterations=3"
    names = (f"ekf:{options}", f"ekf_joint:{options}")
    one, joint = (tools.play(make(name, scenario), scenario, [0, 1], 15) for name in names)
    torch.testing.assert_close(joint.position, one.position, rtol=0, atol=1e-9)
    cross = joint.beliefs[-1].covariance.unflatten(-1, (6, -1))
    own = cross.diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)
    torch.testing.assert_close(own, one.beliefs[-1].covariance, rtol=1e-9, atol=1e-12)
    assert cross[:, 0, :, 1].abs().max() < 1e-12


def test_old_messages_are_moved_to_now(tools: SimpleNamespace) -> None:
    late = make_scenario("indoor-v0", message_delay=5, landmarks=6)
    soon = make_scenario("indoor-v0", landmarks=6)
    assert tools.score("ekf", late, 5, 60).rmse < 1.2 * tools.score("ekf", soon, 5, 60).rmse


def test_dead_reckoning_drifts_honestly(tools: SimpleNamespace) -> None:
    found = tools.score("dead_reckoning", make_scenario("indoor-v0"), 20, 60)
    assert found.rmse > 3
    assert 2 < found.nees.mean() < 4
    assert 2 < found.nees[:, -1].mean() < 4


# ---------------------------------------------------------------- robust


@pytest.mark.parametrize(
    ("name", "trouble", "robust", "share"),
    crossed(
        ["ekf", "ekf_joint"],
        [
            ({"nlos": 0.3}, "huber", 0.85),
            ({"nlos": 0.3}, "gate", 0.8),
            ({"false_matches": 0.1}, "huber", 0.2),
            ({"false_matches": 0.1}, "gate", 0.4),
        ],
        every=2,
    ),
    ids=str,
)
def test_robust_weights_help_in_trouble(
    name: str, trouble: dict, robust: str, share: float, tools: SimpleNamespace
) -> None:
    """In every one of the worlds, and against a filter that is far too sure."""
    scenario = make_scenario("indoor-v0", **trouble)
    plain = tools.score(name, scenario, 5, 80)
    sturdy = tools.score(f"{name}:robust={robust}", scenario, 5, 80)
    assert (sturdy.rmse_per_run < share * plain.rmse_per_run).all()
    assert sturdy.nees.mean() < 0.5 * plain.nees.mean()


@pytest.mark.parametrize("robust", ["huber", "gate"])
def test_robust_weights_cost_little_without_trouble(robust: str, tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0")
    found = tools.score(f"ekf:robust={robust}", scenario, 5, 100)
    assert found.rmse < 1.05 * tools.score("ekf", scenario, 5, 100).rmse


# ---------------------------------------------------------------- what estimates have in common


@pytest.mark.slow
def test_intersection_stays_honest_without_landmarks(tools: SimpleNamespace) -> None:
    """Ten seconds on ranges alone: what goes round in messages is the same news again and again."""
    scenario = make_scenario("indoor-v0", range_only=(2.0, 12.0))
    names = ("ekf", "ekf:fusion=ci", "ekf:fusion=pairwise", "ekf_joint")
    naive, ci, pairwise, joint = (tools.score(name, scenario, 4, 120) for name in names)
    assert naive.nees.mean() > 20
    assert ci.nees.mean() < 4
    assert pairwise.nees.mean() < 5
    assert joint.nees.mean() < 5
    assert pairwise.rmse < 1.1 * naive.rmse
    assert ci.rmse < 2.5 * naive.rmse


FAR, OWN_STD, THEIR_STD, RANGE_STD = 1000.0, 2.0, 0.9, 0.2


def updated(fusion: str, excess: float) -> tuple[float, float]:
    """A UAV's x and its variance after a range, ``excess`` m longer than expected, to a UAV far
    away along x that knows itself to ``THEIR_STD``."""
    scenario = make_scenario("indoor-v0", imu=False, landmarks=0, n_uavs=2, prior_std=OWN_STD)
    seen = World(scenario).reset(0)
    prior = torch.zeros_like(seen["prior"])
    prior[..., -5:] = seen["prior"][..., -5:]
    only = torch.zeros(1, 2, 2)
    only[0, 0, 1] = 1.0
    message = torch.tensor([FAR, 0.0, 0.0, 0.0, 0.0, 0.0] + [math.log(THEIR_STD)] * 3)
    seen = Observation(
        {
            **seen.leaves,
            "prior": prior,
            "ranges": only * (FAR + excess),
            "range_mask": only,
            "messages": (only.unsqueeze(-1) * message).flatten(-2),
            "message_mask": only,
        }
    )
    localizer = make(f"ekf:fusion={fusion}", scenario)
    _, estimate = localizer.step(localizer.reset(seen), seen)
    return float(estimate.position[0, 0, 0]), float(estimate.covariance[0, 0, 0, 0])


def fused(fusion: str) -> tuple[float, float]:
    """Gain −∂x̂/∂r, and the variance claimed."""
    (plus, claimed), (minus, _) = (updated(fusion, excess) for excess in (0.5, -0.5))
    return minus - plus, claimed


def mean_square(gain: float, correlation: float) -> float:
    """Of the error e − g (e − e′ − v), if the errors e, e′ of the two UAVs are so correlated."""
    own, cross = OWN_STD**2, correlation * OWN_STD * THEIR_STD
    others = THEIR_STD**2 + RANGE_STD**2
    return (1 - gain) ** 2 * own + gain**2 * others + 2 * gain * (1 - gain) * cross


@pytest.mark.parametrize("correlation", [-1.0, -0.5, 0.0, 0.3, 0.45, 0.7, 0.9, 1.0])
def test_intersection_never_claims_too_much(correlation: float) -> None:
    """Whatever the errors have in common, the claim covers the true mean square, and so the
    posterior of a filter that knows the correlation."""
    gain, claimed = fused("ci")
    assert 0.1 < gain < 1
    assert claimed < 0.9 * OWN_STD**2
    assert mean_square(gain, correlation) <= claimed + 1e-4
    own, cross = OWN_STD**2, correlation * OWN_STD * THEIR_STD
    innovation = own + THEIR_STD**2 - 2 * cross + RANGE_STD**2
    assert own - (own - cross) ** 2 / innovation <= claimed + 1e-4


def test_naive_fusion_claims_too_much_where_errors_are_shared() -> None:
    gain, claimed = fused("naive")
    assert mean_square(gain, 0.0) == pytest.approx(claimed, rel=1e-3)
    assert mean_square(gain, 0.9) > 1.5 * claimed
