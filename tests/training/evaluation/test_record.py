"""Run records: every number against a single world, and nothing that goes wrong is dropped."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from agents.registry import make
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.world import World
from training.evaluation.record import RunRecord, Worlds, nees, record

SEEDS = torch.arange(3, 9)


def scenario(**overrides: object) -> Scenario:
    return make_scenario("indoor-v0", **{"n_uavs": 3, "horizon": 15} | overrides)


def run(agent: str, scene: Scenario, seeds: torch.Tensor = SEEDS) -> tuple[SimpleNamespace, int]:
    """A record's arrays as tensors, and how many steps of all runs were reported as done."""
    ticks: list[int] = []
    found = record(make(agent, scene), scene, seeds, ticks.append)
    arrays = found.worlds.to_arrays() | found.to_arrays()[0]
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    series = {name: torch.from_numpy(array) for name, array in found.series.items()}
    return SimpleNamespace(**tensors, series=series, messages=found.messages), sum(ticks)


def test_a_record_says_what_single_worlds_say() -> None:
    scene = scenario(failure_rate=0.5)
    found, ticks = run("test_still:offset=0.1", scene)
    assert ticks == len(SEEDS) * 15
    for row, seed in enumerate(SEEDS.tolist()):
        world = World(scene)
        prior = world.reset(seed)["prior"][0, :, :3].clone()
        for k in range(15):
            prior[:, :2] += 0.1
            truth = world.truth
            offset = prior.double() - truth.position[0]
            action = torch.cat((prior, torch.zeros(3, 6)), -1).unsqueeze(0)
            step = world.step(action)
            assert torch.equal(found.truth[row, k], truth.position[0])
            if row == 0:
                assert torch.equal(found.attitude[k], truth.attitude[0])
            assert torch.equal(found.scored[row, k], step.scored[0])
            assert torch.equal(found.error[row, k], step.error[0])
            assert torch.equal(found.offset[row, k], offset.float())
            torch.testing.assert_close(found.nees[row, k], (offset**2).sum(-1).float() / 4)
    assert not found.scored.all()
    assert not found.broken.any()
    assert torch.equal(found.series["particles"][2, :, 1], 100.0 + torch.arange(15))


def test_nees_against_numpy() -> None:
    rng = np.random.default_rng(0)
    root, offset = rng.normal(size=(5, 3, 3)), rng.normal(size=(5, 3))
    covariance = root @ root.swapaxes(-1, -2)
    expected = np.einsum("bi,bij,bj->b", offset, np.linalg.inv(covariance), offset)
    covariance[3], covariance[4] = -np.eye(3), np.nan
    found = nees(torch.from_numpy(offset), torch.from_numpy(covariance)).numpy()
    np.testing.assert_allclose(found[:3], expected[:3])
    assert np.isnan(found[3:]).all()


@pytest.mark.parametrize("wrong", ["nan", "huge"])
def test_estimates_that_are_not_finite_hold_the_last_one(wrong: str) -> None:
    scene = scenario()
    found, _ = run(f"test_still:offset=0.1:wrong={wrong}:at=6:west=19", scene)
    good, _ = run("test_still:offset=0.1", scene)
    struck = found.broken
    assert 0 < struck.sum() < len(SEEDS)
    assert torch.equal(found.error[~struck], good.error[~struck])
    assert torch.equal(found.error[:, :6], good.error[:, :6])
    assert torch.equal(found.error[:, :, 1:], good.error[:, :, 1:])
    estimate = (found.truth + found.offset)[struck][:, 5:, 0]
    torch.testing.assert_close(estimate, estimate[:, :1].expand_as(estimate), atol=1e-5, rtol=0)
    assert not found.messages


def test_estimates_never_finite_hold_the_prior() -> None:
    scene = scenario()
    found, _ = run("test_still:wrong=nan", scene)
    good, _ = run("test_still", scene)
    assert found.broken.all()
    assert torch.equal(found.error, good.error)


def test_a_failed_uav_may_say_what_it_likes() -> None:
    scene = scenario()
    object.__setattr__(scene, "failures", ((0, 6),))
    assert not run("test_still:wrong=nan:at=6", scene)[0].broken.any()
    assert run("test_still:wrong=nan:at=5", scene)[0].broken.all()


def test_who_raises_is_found_and_others_go_on() -> None:
    scene = scenario()
    found, ticks = run("test_still:offset=0.1:wrong=raises:at=6:west=19", scene)
    good, _ = run("test_still:offset=0.1", scene)
    struck = found.broken
    assert ticks == len(SEEDS) * 15
    assert 0 < struck.sum() < len(SEEDS)
    assert len(found.messages) == struck.sum()
    assert found.messages[0] == "step 6: RuntimeError: the matrix is singular"
    assert torch.equal(found.truth, good.truth)
    assert torch.equal(found.error[~struck], good.error[~struck])
    assert torch.equal(found.error[:, :6], good.error[:, :6])
    estimate = (found.truth + found.offset)[struck][:, 5:]
    torch.testing.assert_close(estimate, estimate[:, :1].expand_as(estimate), atol=1e-5, rtol=0)
    assert found.nees[struck][:, 6:].isnan().all()
    assert found.series["particles"][struck][:, 6:].isnan().all()


def test_what_is_not_numerical_is_raised() -> None:
    with pytest.raises(NotImplementedError):
        run("test_still:wrong=missing", scenario())


def test_a_record_survives_arrays() -> None:
    scene = scenario()
    found = record(make("test_still:offset=0.1:wrong=raises:at=6:west=19", scene), scene, SEEDS)
    arrays, facts = found.to_arrays()
    facts = json.loads(json.dumps(facts))
    worlds = Worlds.from_arrays(found.worlds.seed, found.worlds.to_arrays())
    again = RunRecord.from_arrays(worlds, arrays, facts)
    for name in ("offset", "error", "nees", "broken"):
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))
    assert again.series.keys() == found.series.keys() > set()
    assert (again.messages, again.ms_per_step) == (found.messages, None)


def test_blocks_of_runs_are_one_record() -> None:
    scene = scenario()
    localizer = make("ekf", scene)
    whole = record(localizer, scene, SEEDS)
    parts = [record(localizer, scene, part) for part in SEEDS.split(2)]
    joined = RunRecord.cat(parts)
    np.testing.assert_array_equal(joined.error, whole.error)
    np.testing.assert_array_equal(joined.worlds.truth, whole.worlds.truth)
