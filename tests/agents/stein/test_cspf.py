"""The collaborative Stein particle filter and its baselines in their worlds."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from agents import make
from agents.stein.cspf import SteinFilter
from coloc_env.observation import Observation
from coloc_env.scenarios import make_scenario
from coloc_env.world import World
from tests.sampling import slowly
from training.evaluation.team import team_figures

STRANGER = 1


def converged(name: str, agent: str, seeds: int, steps: int, **overrides: Any) -> Tensor:
    """Which worlds have converged after so many steps."""
    scenario = make_scenario(name, **overrides)
    localizer, world = make(agent, scenario), World(scenario, seeds)
    observation = world.reset(0)
    belief = localizer.reset(observation)
    for _ in range(steps):
        belief, estimate = localizer.step(belief, observation)
        said, truth = localizer.team(belief), world.truth
        world.advance(estimate.action())
        observation = world.observation()
    assert said is not None
    return team_figures(said, truth)["converged"][:, 0] > 0


@pytest.mark.parametrize(
    ("name", "agent", "steps"),
    [
        ("stein2d-v0", "cspf", 90),
        ("stein2d-v0", "pose_graph:every=60", 60),
        *slowly(
            ("stein2d-v0", "cspf:particles=1", 90),
            ("stein3d-v0", "cspf:particles=20", 70),
            ("stein2d-v0", "pf_joint:anneal=0.96", 130),
            ("stein3d-v0", "pose_graph:robust=gnc:every=40", 40),
        ),
    ],
)
def test_teams_find_each_other(name: str, agent: str, steps: int) -> None:
    assert converged(name, agent, 6, steps).sum() >= 5


@pytest.mark.slow
def test_ten_share_the_penalty_and_find_each_other() -> None:
    ten = {"n_uavs": 10, "matches_per_step": 3}
    assert converged("stein2d-v0", "cspf:particles=1", 6, 100, **ten).sum() >= 5
    each_its_own = "cspf:particles=1:gamma=9"
    assert converged("stein2d-v0", each_its_own, 6, 100, **ten).sum() <= 3


def test_a_plain_bootstrap_filter_does_not() -> None:
    assert converged("stein2d-v0", "pf_joint", 6, 130).sum() <= 1


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["paper", "paper_corrected"])
def test_the_paper_as_printed_does_not(variant: str) -> None:
    assert converged("stein2d-v0", f"cspf:variant={variant}:particles=20", 6, 90).sum() == 0


def test_agents_other_than_0_can_be_renumbered(tools: SimpleNamespace) -> None:
    """Without odometry noise nothing is drawn after the start: permuted beliefs and observations
    give permuted estimates."""
    scenario = make_scenario("stein2d-v0", n_uavs=4, odometry_noise=(0.0, 0.0))
    localizer = make("cspf:particles=12", scenario)
    run = tools.play(localizer, scenario, [0, 1], 12)
    order = torch.tensor([0, 3, 1, 2])
    back = order.argsort()
    before, observation = run.beliefs[11], run.observations[11]

    def renumbered(index: Tensor) -> Tensor:
        return back[index]

    leaves = {name: leaf[:, order] for name, leaf in observation.leaves.items()}
    leaves["links"] = leaves["links"][..., order]
    ends = leaves["relative_pose_ends"].long()
    leaves["relative_pose_ends"] = renumbered(ends).float() * leaves[
        "relative_pose_mask"
    ].repeat_interleave(2, -1)
    window = before.window[:, order]
    tracks = before.tracks[:, order]
    other = before[:, order].replace(
        x=before.x[:, order][:, :, order],
        estimate=before.estimate[:, order][:, :, order],
        edges=before.edges[:, order][:, :, order][:, :, :, order],
        started=before.started[:, order][:, :, order],
        window=window.replace(first=renumbered(window.first), second=renumbered(window.second)),
        tracks=tracks.replace(received=tracks.received[:, :, order], age=tracks.age[:, :, order]),
    )
    expected, estimate = localizer.step(before, observation)
    found, permuted = localizer.step(other, Observation(leaves))
    close = {"rtol": 0, "atol": 1e-8}
    torch.testing.assert_close(found.estimate, expected.estimate[:, order][:, :, order], **close)
    torch.testing.assert_close(permuted.position, estimate.position[:, order], **close)
    torch.testing.assert_close(permuted.covariance, estimate.covariance[:, order], **close)


def test_nan_harms_nobody_else(tools: SimpleNamespace) -> None:
    """A UAV whose sensors fail for two steps counts as standing still and seeing nothing."""
    scenario = make_scenario("stein2d-v0", n_uavs=4)
    localizer = make("cspf:particles=12", scenario)
    run = tools.play(localizer, scenario, [0, 1], 20)
    spoiled = list(run.observations)
    for k in (15, 16):
        leaves = {name: leaf.clone() for name, leaf in spoiled[k].leaves.items()}
        for name in leaves.keys() - {"links"}:
            leaves[name][0, STRANGER] = math.nan
        spoiled[k] = Observation(leaves)
    moved = tools.replay(localizer, spoiled)
    others = [0, 2, 3]
    for one in moved.estimates:
        assert one.position[:, others].isfinite().all()
        assert one.covariance[:, others].isfinite().all()
    assert moved.beliefs[-1].estimate[:, others].isfinite().all()
    torch.testing.assert_close(moved.position[:, 1], run.position[:, 1], rtol=0, atol=0)


@pytest.mark.slow
def test_a_uav_that_was_not_heard_is_caught_up_with() -> None:
    """Links that come and go: holders learn later what others did meanwhile."""
    lossy = {"message_loss": 0.3, "outliers": 0.1}
    assert converged("stein2d-v0", "cspf:particles=10", 6, 110, **lossy).sum() >= 5


def test_broadcast_tells_everybody_everything(tools: SimpleNamespace) -> None:
    scenario = make_scenario("stein2d-v0", n_uavs=4)
    counts = {}
    for agent in ("cspf:particles=2", "cspf:particles=2:broadcast=true"):
        belief = tools.play(make(agent, scenario), scenario, [0, 1, 2], 10).beliefs[-1]
        counts[agent] = belief.window.mask.sum(-1)
    own, everyone = counts.values()
    assert (everyone == 10).all()
    assert (own.sum(-1) == 20).all()


def test_a_holder_without_inliers_restarts() -> None:
    """A team with wrong matches only restarts, time and again."""
    scenario = make_scenario("stein2d-v0", outliers=1.0)
    localizer, world = make("cspf:particles=10:anneal=0.8:iterations=1", scenario), World(scenario)
    observation = world.reset(0)
    belief, young = localizer.reset(observation), 0
    for k in range(60):
        belief, estimate = localizer.step(belief, observation)
        young += int((belief.annealed < k).sum())
        world.advance(estimate.action())
        observation = world.observation()
    assert young > 0


@pytest.mark.parametrize(
    ("agent", "words"),
    [
        ("cspf:particles=0", "cspf: particles='0' is not allowed: a whole number ≥ 1"),
        ("cspf:gamma=0", "cspf: gamma='0' is not allowed: a number > 0"),
        ("cspf:outliers=1", "cspf: outliers='1' is not allowed: a number > 0 and < 1"),
        ("cspf:anneal=1.5", "cspf: anneal='1.5' is not allowed: a number > 0 and ≤ 1"),
        ("cspf:variant=better", "cspf: variant='better' is not allowed: one of settled"),
        (
            "pf_joint:particles=1",
            "pf_joint: particles='1' is not allowed: a whole number from 2 to",
        ),
        ("pose_graph:every=0", "pose_graph: every='0' is not allowed: a whole number ≥ 1"),
    ],
)
def test_wrong_options_are_named(agent: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make(agent, make_scenario("stein2d-v0"))


def test_other_teams_are_refused() -> None:
    scenario = make_scenario("indoor-v0")
    with pytest.raises(ValueError, match="cspf: what the team measures with Landmarks, Ranging"):
        make("cspf", scenario)
    with pytest.raises(ValueError, match="a team with relative poses, odometry and a reference"):
        SteinFilter(scenario.believed)


def test_figures_of_the_team() -> None:
    world = World(make_scenario("stein3d-v0"), 2)
    world.reset(0)
    pose = torch.cat((world.truth.position, world.truth.attitude), -1)
    said = pose.unsqueeze(1).repeat(1, 3, 1, 1)
    figures = team_figures(said, world.truth)
    assert not figures["team_error"].any()
    assert (figures["converged"] == 1).all()
    said[0, 2, 1, 0] += 0.4
    said[1, 1, 2, 3:] = torch.tensor([math.cos(0.1), 0.0, math.sin(0.1), 0.0])
    figures = team_figures(said, world.truth)
    torch.testing.assert_close(figures["team_error"][0], torch.tensor([0.0, 0.0, 0.4]))
    torch.testing.assert_close(figures["team_turn"][1], torch.tensor([0.0, 0.2, 0.0]))
    assert not figures["converged"].any()
