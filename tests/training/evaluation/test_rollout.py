"""Runs on tape: every number against a single world, and nothing that goes wrong is dropped."""

import numpy as np
import pytest
import torch

from agents.registry import make
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.world import World
from training.evaluation.rollout import Tape, nees, play

SEEDS = torch.arange(3, 9)


def scenario(**overrides: object) -> Scenario:
    return make_scenario("indoor-v0", **{"n_uavs": 3, "horizon": 15} | overrides)


def run(agent: str, scene: Scenario, seeds: torch.Tensor = SEEDS) -> tuple[Tape, int]:
    ticks: list[int] = []
    return play(make(agent, scene), scene, seeds, ticks.append), sum(ticks)


def test_tape_says_what_single_worlds_say() -> None:
    scene = scenario(failure_rate=0.5)
    tape, ticks = run("test_still:offset=0.1", scene)
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
            assert torch.equal(tape.truth[row, k], truth.position[0])
            assert torch.equal(tape.attitude[row, k], truth.attitude[0])
            assert torch.equal(tape.scored[row, k], step.scored[0])
            assert torch.equal(tape.error[row, k], step.error[0])
            assert torch.equal(tape.offset[row, k], offset.float())
            torch.testing.assert_close(tape.nees[row, k], (offset**2).sum(-1).float() / 4)
    assert not tape.scored.all()
    assert not tape.broken.any()
    assert torch.equal(tape.series["particles"][2, :, 1], 100.0 + torch.arange(15))


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
    tape, _ = run(f"test_still:offset=0.1:wrong={wrong}:at=6:west=19", scene)
    good, _ = run("test_still:offset=0.1", scene)
    struck = tape.broken
    assert 0 < struck.sum() < len(SEEDS)
    assert torch.equal(tape.error[~struck], good.error[~struck])
    assert torch.equal(tape.error[:, :6], good.error[:, :6])
    assert torch.equal(tape.error[:, :, 1:], good.error[:, :, 1:])
    estimate = (tape.truth + tape.offset)[struck][:, 5:, 0]
    torch.testing.assert_close(estimate, estimate[:, :1].expand_as(estimate), atol=1e-5, rtol=0)
    assert not tape.raised


def test_estimates_never_finite_hold_the_prior() -> None:
    scene = scenario()
    tape, _ = run("test_still:wrong=nan", scene)
    good, _ = run("test_still", scene)
    assert tape.broken.all()
    assert torch.equal(tape.error, good.error)


def test_a_failed_uav_may_say_what_it_likes() -> None:
    scene = scenario()
    object.__setattr__(scene, "failures", ((0, 6),))
    assert not run("test_still:wrong=nan:at=6", scene)[0].broken.any()
    assert run("test_still:wrong=nan:at=5", scene)[0].broken.all()


def test_who_raises_is_found_and_others_go_on() -> None:
    scene = scenario()
    tape, ticks = run("test_still:offset=0.1:wrong=raises:at=6:west=19", scene)
    good, _ = run("test_still:offset=0.1", scene)
    struck = tape.broken
    assert ticks == len(SEEDS) * 15
    assert 0 < struck.sum() < len(SEEDS)
    assert len(tape.raised) == struck.sum()
    assert tape.raised[0] == "step 6: RuntimeError: the matrix is singular"
    assert torch.equal(tape.truth, good.truth)
    assert torch.equal(tape.error[~struck], good.error[~struck])
    assert torch.equal(tape.error[:, :6], good.error[:, :6])
    estimate = (tape.truth + tape.offset)[struck][:, 5:]
    torch.testing.assert_close(estimate, estimate[:, :1].expand_as(estimate), atol=1e-5, rtol=0)
    assert tape.nees[struck][:, 6:].isnan().all()
    assert tape.series["particles"][struck][:, 6:].isnan().all()


def test_what_is_not_numerical_is_raised() -> None:
    with pytest.raises(NotImplementedError):
        run("test_still:wrong=missing", scenario())
