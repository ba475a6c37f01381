"""Swarm localizers in ``swarm-v0``: how good, how honest, and what broken networks do to them."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from agents import make
from agents.swarm import persistence
from coloc_env.scenarios import make_scenario
from coloc_env.world import World
from training.evaluation.evaluate import evaluate
from training.evaluation.metrics import rmse

SMALL: dict[str, Any] = {"n_uavs": 40, "anchor_share": 0.25, "ins_bias": 0.0, "horizon": 25}
PAPERS = "dwmds_st:confidence=paper:v_max=50"
METHODS = ("dwmds_st", "dwmds_st:window=3", PAPERS, "gn", "map", "mds")


def episode(agent: str, seeds: Tensor, steps: int = 8, **overrides: Any) -> list[Tensor]:
    """Estimated positions and covariances of some worlds, step by step."""
    scenario = make_scenario("swarm-v0", **SMALL | overrides)
    localizer, world = make(agent, scenario), World(scenario, len(seeds))
    observation = world.reset(seeds)
    belief, found = localizer.reset(observation), []
    for _ in range(steps):
        belief, estimate = localizer.step(belief, observation)
        found += [estimate.position, estimate.covariance]
        world.advance(estimate.action())
        observation = world.observation()
    return found


@pytest.fixture(scope="module")
def results() -> Any:
    agents = ["dwmds_st", "dwmds_st:confidence=huber", "gn", "map", "mds", "dead_reckoning"]
    return evaluate(make_scenario("swarm-v0", **SMALL | {"n_uavs": 70}), agents, 2)


def error(results: Any, agent: str) -> float:
    late = slice(10, None)
    return rmse(results.agents[agent].error[:, late], results.worlds.scored[:, late])


def test_more_information_gives_smaller_errors(results: Any) -> None:
    order = ["map", "dwmds_st", "dwmds_st:confidence=huber", "gn", "dead_reckoning"]
    errors = [error(results, agent) for agent in order]
    assert errors == sorted(errors)
    assert errors[1] < 0.8 * errors[2] < 0.8 * errors[3]
    assert error(results, "mds") < 300.0


def test_the_calibrated_ones_are_near_the_bound(results: Any) -> None:
    bound = results.bound.rmse_after(10.0)
    assert bound < error(results, "map") < 1.25 * bound
    assert error(results, "dwmds_st") < 1.5 * bound


@pytest.mark.slow
def test_the_first_step_tells_good_ranges_from_bad() -> None:
    """Half of all ranges with 50 m of noise, a start that is 90 m off: within the bound's reach."""
    overrides = {"n_uavs": 100, "nlos": 0.0, "uwb_tail": 0.5, "horizon": 2}
    results = evaluate(make_scenario("swarm-v0", **SMALL | overrides), ["map", "dwmds_st"], 4)
    assert results.bound is not None
    bound = results.bound.mse.numpy()[:, 0][results.worlds.scored[:, 0]].mean() ** 0.5
    for agent in ("map", "dwmds_st"):
        first = rmse(results.agents[agent].error[:, :1], results.worlds.scored[:, :1])
        assert bound < first < 1.6 * bound, agent


def test_calibrated_covariances_are_honest(results: Any) -> None:
    for agent in ("dwmds_st", "map"):
        nees = results.agents[agent].nees[:, 10:][results.worlds.scored[:, 10:]]
        assert 1.5 < np.nanmean(nees) < 6.0  # ideal: 3


def test_the_error_model_is_reported(results: Any) -> None:
    series = results.agents["dwmds_st"].series
    assert series["outlier_share"][:, -1].mean() == pytest.approx(0.15, abs=0.06)
    assert series["outlier_bias"][:, -1].mean() == pytest.approx(25.0, abs=5.0)


@pytest.mark.parametrize("agent", METHODS)
def test_rows_of_a_batch_are_runs_of_their_own(agent: str) -> None:
    both = episode(agent, torch.tensor([3, 8]))
    for row, seed in enumerate((3, 8)):
        alone = episode(agent, torch.tensor([seed]))
        for x, y in zip(both, alone, strict=True):
            assert torch.allclose(x[row], y[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("agent", METHODS)
def test_a_world_that_restarts_disturbs_no_other(agent: str) -> None:
    scenario = make_scenario("swarm-v0", **SMALL)
    localizer, world = make(agent, scenario), World(scenario, 1)
    first = world.reset(3)
    old, estimate = localizer.step(localizer.reset(first), first)
    world.advance(estimate.action())
    second = world.observation()
    _, alone = localizer.step(old, second)
    fresh = localizer.reset(first)
    together = type(second)({k: torch.cat((x, first[k])) for k, x in second.leaves.items()})
    _, both = localizer.step(torch.cat((old, fresh)), together)
    assert torch.allclose(both.position[:1], alone.position, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("agent", METHODS)
@pytest.mark.parametrize(
    "overrides",
    [
        {"comm_radius": 1.0},  # nobody hears anybody
        {"comm_radius": 1500.0},  # in pieces, some without an anchor
        {"anchor_share": 0.0},
        {"link_failure": 1.0},
        {"failure_rate": 1.0, "horizon": 4},
    ],
    ids=str,
)
def test_no_network_is_too_broken(agent: str, overrides: dict[str, Any]) -> None:
    for found in episode(agent, torch.tensor([0]), steps=4, **overrides):
        assert found.isfinite().all()


@pytest.mark.parametrize("agent", ["dwmds_st", "map"])
def test_without_links_they_dead_reckon_with_its_covariance(agent: str) -> None:
    seeds = torch.tensor([0])
    alone = episode(agent, seeds, comm_radius=1.0)
    reckoned = episode("dead_reckoning", seeds, comm_radius=1.0)
    anchors = 10
    for x, y in zip(alone[::2], reckoned[::2], strict=True):
        assert torch.allclose(x[:, anchors:], y[:, anchors:], atol=1e-3)
    first, last = alone[1][:, anchors:], alone[-1][:, anchors:]
    assert (last.diagonal(dim1=-2, dim2=-1) > first.diagonal(dim1=-2, dim2=-1)).all()


@pytest.mark.parametrize("agent", ["dwmds_st", "map"])
def test_without_anchors_the_mean_position_is_dead_reckoned(agent: str) -> None:
    scenario = make_scenario("swarm-v0", **SMALL | {"anchor_share": 0.0, "n_uavs": 12})
    localizer, world = make(agent, scenario), World(scenario, 1)
    observation = world.reset(2)
    belief = localizer.reset(observation)
    for step in range(6):
        belief, estimate = localizer.step(belief, observation)
        world.advance(estimate.action())
        observation = world.observation()
        rows = belief.joint.shape[2]
        blocks = belief.joint.unflatten(-1, (-1, rows)).diagonal(dim1=2, dim2=4)[0]
        reckoned = 50.0**2 + 0.5**2 * step  # that of the middle of 12, each on its own
        assert blocks.mean((0, 1)).tolist() == pytest.approx(rows * [reckoned / 12], rel=1e-4)
        assert not belief.localizable.any()


def run(agent: str, **overrides: Any) -> Any:
    results = evaluate(make_scenario("swarm-v0", **SMALL | overrides), [agent], 1, bound=False)
    return results, error(results, agent)


def test_the_ins_bias_is_taken_off() -> None:
    (_, without), (_, with_bias) = (
        run(agent, ins_bias=1.0, horizon=60) for agent in ("dwmds_st:bias=false", "dwmds_st")
    )
    assert with_bias < 0.9 * without


@pytest.mark.slow
def test_persistent_nlos_is_recognized(monkeypatch: pytest.MonkeyPatch) -> None:
    world: dict[str, Any] = {"n_uavs": 80, "nlos": 0.5, "horizon": 30}
    lasting, fresh = (run("dwmds_st", **world, nlos_time=time) for time in (10.0, None))
    persistence_ = [
        one[0].agents["dwmds_st"].series["outlier_persistence"][0, -1, 0]
        for one in (lasting, fresh)
    ]
    assert persistence_[0] > 0.6 > 0.25 > persistence_[1]
    monkeypatch.setattr(persistence, "_MAX_PERSISTENCE", 0.0)  # every step for itself
    _, forgetful = run("dwmds_st", **world, nlos_time=10.0)
    assert lasting[1] < 0.9 * forgetful


@pytest.mark.parametrize(
    ("agent", "scenario", "words"),
    [
        ("dwmds_st:iterations=0", "swarm-v0", "iterations='0' is not allowed"),
        ("dwmds_st:confidence=much", "swarm-v0", "confidence='much' is not allowed"),
        ("dwmds_st:v_max=0", "swarm-v0", "v_max='0' is not allowed"),
        ("map:iterations=0", "swarm-v0", "iterations='0' is not allowed"),
        ("gn", "wsn-v0", "a team with ranges between UAVs"),
    ],
)
def test_wrong_options(agent: str, scenario: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make(agent, make_scenario(scenario))


# ---------------------------------------------------------------- exact priors, corrections

EVERY = (*METHODS, "dwmds", "vmds", "fcmds", "stdcl:variant=calibrated:weights=none")


@pytest.mark.parametrize("agent", EVERY)
@pytest.mark.parametrize("family", ["swarm-v0", "campus-v0"])
def test_an_exact_prior_is_kept(agent: str, family: str) -> None:
    """With ``prior_std=0`` the first estimates are as good as the truth that they start from, and
    no matrix is singular."""
    small = {"n_uavs": 12, "ins_bias": 0.5} if family == "swarm-v0" else {}
    scenario = make_scenario(family, prior_std=0.0, horizon=6, **small)
    localizer, world = make(agent, scenario), World(scenario, 2)
    observation = world.reset(0)
    belief = localizer.reset(observation)
    for step in range(6):
        belief, estimate = localizer.step(belief, observation)
        assert estimate.position.isfinite().all()
        assert (torch.linalg.eigvalsh(estimate.covariance) > 0).all()
        if step == 0 and getattr(localizer, "recursive", False) and agent != "fcmds":
            off = (estimate.position - world.truth.position).norm(dim=-1)
            free = observation["position_fix_mask"][..., 0] == 0
            assert off[free].max() < 0.01
        world.advance(estimate.action())
        observation = world.observation()


@pytest.mark.parametrize("agent", ["dwmds_st", "map", "stdcl:variant=calibrated:weights=none"])
def test_a_moved_belief_is_the_belief_of_a_moved_position(agent: str) -> None:
    """Without links the estimate follows the correction, and nothing else of it changes."""
    scenario = make_scenario("swarm-v0", **SMALL | {"comm_radius": 1.0, "anchor_share": 0.0})
    localizer, world = make(agent, scenario), World(scenario, 1)
    observation = world.reset(0)
    belief, _ = localizer.step(localizer.reset(observation), observation)
    offset = torch.tensor([3.0, -2.0, 1.0], dtype=torch.float64).expand(1, SMALL["n_uavs"], 3)
    moved = localizer.shifted(belief, offset)
    torch.testing.assert_close(localizer.mean(moved)[..., :3] - localizer.mean(belief)[..., :3],
                               offset, rtol=0, atol=1e-9)  # fmt: skip
    (_, before), (_, after) = (localizer.step(x, observation) for x in (belief, moved))
    torch.testing.assert_close(after.position - before.position, offset, rtol=0, atol=1e-9)
    torch.testing.assert_close(after.covariance, before.covariance)
