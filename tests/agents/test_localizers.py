"""What every registered localizer must do, in every family of scenarios: protocol and purity."""

import math
from types import SimpleNamespace

import pytest
import torch
from tensordict import is_tensorclass

from agents import LOCALIZERS, make
from agents.kalman.emvf import MinimumVarianceFir
from agents.policies.learned import PolicyAgent
from agents.stein.team import RelativeTeam
from agents.swarm.gn import Snapshot
from coloc_env.observation import Observation, action_width
from tests.sampling import crossed

EXACT = 0.0
SUMMED = 1e-10  # relative, for products of matrices over a whole team, summed in another order


def copies(observation: Observation) -> Observation:
    return Observation({name: leaf.clone() for name, leaf in observation.leaves.items()})


# ---------------------------------------------------------------- protocol


def test_beliefs_and_estimates_have_the_shapes_promised(case: SimpleNamespace) -> None:
    arena = case.scenario.arena
    batch, d = (2, arena.n_uavs), arena.dim
    for belief in case.run.beliefs:
        assert is_tensorclass(belief)
        assert belief.batch_size == batch
    for estimate in case.run.estimates:
        assert estimate.batch_size == batch
        assert estimate.position.shape == estimate.velocity.shape == (*batch, d)
        assert estimate.covariance.shape == (*batch, d, d)
        for value in (estimate.position, estimate.velocity, estimate.covariance):
            assert value.is_floating_point()
            assert value.isfinite().all()
        action = estimate.action()
        assert action.dtype == torch.float32
        assert action.shape == (*batch, action_width(case.scenario))
    figures = case.localizer.diagnostics(case.run.beliefs[-1])
    assert all(value.shape == batch for value in figures.values())


def test_covariances_are_symmetric_and_positive(case: SimpleNamespace) -> None:
    for estimate in case.run.estimates:
        covariance = estimate.covariance.double()
        scale = covariance.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        assert ((covariance - covariance.mT).abs() <= 1e-6 * scale).all()
        assert (torch.linalg.eigvalsh(covariance) > 0).all()


def test_the_action_says_what_the_estimate_says(sample: SimpleNamespace) -> None:
    estimate, d = sample.run.estimates[-1], sample.scenario.arena.dim
    position, velocity, log_std = estimate.action().double().split(d, -1)
    variance = estimate.covariance.diagonal(dim1=-2, dim2=-1).double()
    torch.testing.assert_close(position, estimate.position.double(), rtol=1e-6, atol=1e-5)
    torch.testing.assert_close(velocity, estimate.velocity.double(), rtol=1e-6, atol=1e-5)
    torch.testing.assert_close((2 * log_std).exp(), variance, rtol=1e-4, atol=0)


# ---------------------------------------------------------------- purity


def test_step_is_pure(sample: SimpleNamespace, tools: SimpleNamespace) -> None:
    k = 2
    belief, observation = sample.run.beliefs[k], sample.run.observations[k]
    kept_belief, kept = belief.clone(), copies(observation)
    sample.localizer.step(sample.run.beliefs[-1], sample.run.observations[-1])  # leaves no trace
    after, estimate = sample.localizer.step(belief, observation)
    tools.assert_same(belief, kept_belief)
    for name, leaf in kept.leaves.items():
        assert torch.equal(observation[name], leaf), name
    tools.assert_same(after, sample.run.beliefs[k + 1])
    tools.assert_same(estimate, sample.run.estimates[k])


def test_reset_is_pure(sample: SimpleNamespace, tools: SimpleNamespace) -> None:
    observation = sample.run.observations[0]
    kept = copies(observation)
    tools.assert_same(sample.localizer.reset(observation), sample.run.beliefs[0])
    assert all(torch.equal(observation[name], leaf) for name, leaf in kept.leaves.items())


def test_a_run_can_be_repeated(sample: SimpleNamespace, tools: SimpleNamespace) -> None:
    again = tools.play(tools.build(sample.name, sample.scenario), sample.scenario, (3, 4), 4)
    for one, other in zip(again.estimates, sample.run.estimates, strict=True):
        tools.assert_same(one, other)
    tools.assert_same(again.beliefs[-1], sample.run.beliefs[-1])


def test_steps_do_not_touch_the_global_generator(sample: SimpleNamespace) -> None:
    before = torch.get_rng_state()
    sample.localizer.step(sample.run.beliefs[0], sample.run.observations[0])
    assert torch.equal(torch.get_rng_state(), before)


# ---------------------------------------------------------------- batches


def test_a_row_of_a_batch_is_its_own_run(sample: SimpleNamespace, tools: SimpleNamespace) -> None:
    """Exactly, but for sums over the team: particles would multiply any rounding by thousands."""
    summed = (
        sample.localizer.centralized or "fusion=exchange" in sample.name
    )  # everybody's joint filter
    tolerance = SUMMED if summed else EXACT
    for row, seed in enumerate((3, 4)):
        alone = tools.play(sample.localizer, sample.scenario, [seed], 4)
        for one, many in zip(alone.estimates, sample.run.estimates, strict=True):
            tools.assert_same(one, many[row : row + 1], tolerance)


@pytest.mark.parametrize("name", LOCALIZERS)
def test_rows_do_not_depend_on_how_many_there_are(name: str, tools: SimpleNamespace) -> None:
    """Hybrids hold a Kalman filter among anchors, whose last row of many is an ulp off; so are
    products of matrices as large as a map's."""
    scenario = tools.room(name)
    localizer = tools.build(name, scenario)
    tolerance = SUMMED if localizer.centralized or name in ("hpff", "nnhpff", "slam") else EXACT
    many = tools.play(localizer, scenario, range(70), 2)
    for seed in (0, 69):
        alone = tools.play(localizer, scenario, [seed], 2)
        tools.assert_same(alone.beliefs[-1], many.beliefs[-1][seed : seed + 1], tolerance)


@pytest.mark.parametrize(("name", "n_uavs"), crossed(LOCALIZERS, [1, 2], every=2))
def test_a_row_of_a_small_team_is_its_own_run(
    name: str, n_uavs: int, tools: SimpleNamespace
) -> None:
    """Also where a team has one pair of UAVs, or one UAV and no neighbours at all."""
    scenario = tools.room(name, n_uavs=n_uavs)
    localizer = tools.build(name, scenario)
    tolerance = SUMMED if localizer.centralized or name == "slam" else EXACT
    many = tools.play(localizer, scenario, range(3), 4)
    for seed in (0, 2):
        alone = tools.play(localizer, scenario, [seed], 4)
        for one, other in zip(alone.estimates, many.estimates, strict=True):
            tools.assert_same(one, other[seed : seed + 1], tolerance)
        tools.assert_same(alone.beliefs[-1], many.beliefs[-1][seed : seed + 1], tolerance)


# ---------------------------------------------------------------- time


def test_the_first_step_predicts_nothing(sample: SimpleNamespace, tools: SimpleNamespace) -> None:
    """What drives the motion model at the first observation has no step behind it."""
    first = sample.run.observations[0]
    driven = {name: 7 + 3 * first[name] for name in ("imu", "odometry") if name in first}
    rest = sample.run.observations[1:]
    changed = tools.replay(sample.localizer, [tools.change(first, **driven), *rest])
    for one, other in zip(changed.estimates, sample.run.estimates, strict=True):
        tools.assert_same(one, other)
    if driven:
        later = [first, tools.change(sample.run.observations[1], **driven)]
        moved = tools.replay(sample.localizer, later).estimates[1]
        assert not torch.equal(moved.position, sample.run.estimates[1].position)


def test_without_measurements_the_first_estimate_is_the_prior(
    case: SimpleNamespace, tools: SimpleNamespace
) -> None:
    if "variant=paper" in case.name:
        pytest.skip("starts anywhere in the arena, whatever the prior")
    if isinstance(case.localizer, PolicyAgent):
        pytest.skip("what a policy says then is what it has learned")
    if isinstance(case.localizer, MinimumVarianceFir | Snapshot | RelativeTeam):
        pytest.skip("knows no prior")
    first, d = case.run.observations[0], case.scenario.arena.dim
    blind = {mask: torch.zeros_like(first[mask]) for mask in tools.masked_pairs(first)}
    estimate = tools.replay(case.localizer, [tools.change(first, **blind)]).estimates[0]
    prior = first["prior"].double()
    std = prior[..., -d - 2 : -2]
    sampled = {"particles", "main"} & LOCALIZERS.options_of(case.name.split(":")[0]).keys()
    error = 5 / math.sqrt(33) if sampled else 1e-6
    torch.testing.assert_close(
        (estimate.position.double() - prior[..., :d]) / std,
        torch.zeros_like(std),
        rtol=0,
        atol=error,
    )
    whitened = estimate.covariance.double() / (std.unsqueeze(-1) * std.unsqueeze(-2))
    torch.testing.assert_close(
        whitened, torch.eye(d).double().expand_as(whitened), rtol=0, atol=1.5 * error
    )


# ---------------------------------------------------------------- seeds


@pytest.mark.parametrize("name", [n for n in LOCALIZERS if "seed" in LOCALIZERS.options_of(n)])
def test_the_seed_changes_the_draws_and_nothing_else(name: str, tools: SimpleNamespace) -> None:
    scenario = tools.room(name)
    runs = [
        tools.play(make(name, scenario, particles=100, seed=s), scenario, [0], 4) for s in (0, 0, 1)
    ]
    assert torch.equal(runs[0].position, runs[1].position)
    assert not torch.equal(runs[0].position, runs[2].position)
    assert torch.equal(runs[0].observations[0]["prior"], runs[2].observations[0]["prior"])
