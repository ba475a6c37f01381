"""The particle filters in the room: near the bound, as sure as they may be, never weightless."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from agents import Localizer, make
from coloc_env.bounds import posterior_bound
from coloc_env.observation import Observation
from coloc_env.scenario import ConstantVelocity, Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

ROOM = (30.0, 20.0, 5.0)


def first(localizer: Localizer, scenario: Scenario, worlds: int = 2) -> tuple[Any, Observation]:
    """The belief before the first observation, and that observation."""
    seen = World(scenario, worlds).reset(0)
    return localizer.reset(seen), seen


# ---------------------------------------------------------------- as good as can be


def test_the_room_is_localized_near_the_bound(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0")
    found = tools.score("pf800", scenario, 10, 150)
    assert 0.95 < found.rmse / posterior_bound(scenario, 10, 0, 150).rmse < 1.25
    assert tools.consistent(found.nees, 3) > 0.7
    assert 2.3 < found.nees.mean() < 3.7


def test_far_from_the_origin_is_as_good(tools: SimpleNamespace) -> None:
    """Ten kilometres away float32 has steps of a millimetre."""
    near = make_scenario("indoor-v0")
    arena = replace(near.arena, low=(1e4, 1e4, 0.0), high=(1e4 + 30, 1e4 + 20, 5.0))
    far = tools.score("pf500", replace(near, arena=arena), 5, 40)
    assert far.rmse < 1.15 * tools.score("pf500", near, 5, 40).rmse


def test_tempering_saves_the_start(tools: SimpleNamespace) -> None:
    """Used at once, the first likelihoods leave a particle or two."""
    scenario = make_scenario("indoor-v0")
    tempered, plain = (
        tools.score(f"pf500:tempering={choice}", scenario, 5, 30) for choice in ("true", "false")
    )
    assert tempered.nees[:, :5].mean() < 4.5
    assert plain.nees[:, :5].mean() > 3 * tempered.nees[:, :5].mean()
    assert tempered.rmse < plain.rmse


@pytest.mark.parametrize("overrides", [{"prior": "uniform"}, {"imu_bias": True}], ids=str)
def test_harder_starts_are_found(overrides: dict, tools: SimpleNamespace) -> None:
    found = tools.score("pf500", make_scenario("indoor-v0", **overrides), 4, 40)
    assert found.rmse_per_run.max() < 0.15


def test_fixed_perturbation_keeps_its_uavs(tools: SimpleNamespace) -> None:
    found = tools.score("pf500:perturb=fixed", make_scenario("indoor-v0"), 3, 50)
    assert found.rmse_per_run.max() < 0.15


# ---------------------------------------------------------------- the cloud


def test_particles_start_at_the_prior() -> None:
    scenario = make_scenario("indoor-v0", imu_bias=True)
    localizer = make("pf800:particles=4000", scenario)
    belief, seen = first(localizer, scenario)
    mean, spread = belief.particles.mean(2), belief.particles.std(2)
    for part, std in ((slice(0, 3), 2.0), (slice(3, 6), 0.2)):
        assert (mean[..., part] - seen["prior"][..., part]).abs().max() < 5 * std / 63
        assert (spread[..., part] / std - 1).abs().max() < 0.06
    assert (belief.particles[..., 6:10].norm(dim=-1) - 1).abs().max() < 1e-6
    assert (spread[..., 10:13] / 0.1 - 1).abs().max() < 0.06
    assert (spread[..., 13:16] / 0.01 - 1).abs().max() < 0.06


def test_particles_of_a_uniform_prior_fill_the_room() -> None:
    scenario = make_scenario("indoor-v0", prior="uniform")
    belief, _ = first(make("pf800:particles=4000", scenario), scenario)
    place = belief.particles[..., :3] / torch.tensor(ROOM)
    assert (place > 0).all()
    assert (place < 1).all()
    counts = torch.stack([torch.histc(place[0, 0, :, axis], 10, 0, 1) for axis in range(3)])
    assert (counts / 400 - 1).abs().max() < 0.25


def test_particles_of_a_top_speed_have_any_velocity_up_to_it() -> None:
    """Independent of where they are."""
    scenario = make_scenario("wsn-v0", max_speed=2.0)
    belief, _ = first(make("pf", scenario), scenario)
    cloud = belief.particles / torch.tensor([10.0, 10.0, 4.0, 4.0])
    cloud[..., 2:] += 0.5
    assert (cloud > 0).all()
    assert (cloud < 1).all()
    counts = torch.stack([torch.histc(cloud[0, 0, :, axis], 10, 0, 1) for axis in range(4)])
    assert (counts / 500 - 1).abs().max() < 0.25
    apart = torch.corrcoef(cloud[0, 0].T) - torch.eye(4)
    assert apart.abs().max() < 5 / 5000**0.5


def test_every_uav_draws_its_own_numbers() -> None:
    scenario = make_scenario("indoor-v0", prior="uniform")
    belief, _ = first(make("pf500", scenario), scenario, 5)
    assert len(belief.key.unique()) == belief.key.numel()
    place = belief.particles[..., :3].flatten(0, 1)
    apart = (place.unsqueeze(0) - place.unsqueeze(1)).abs().sum((-2, -1))
    assert (apart + 10 * torch.eye(len(place)) > 1).all()


def test_weights_stay_normalized_and_the_count_honest(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0")
    localizer = make("pf500", scenario)
    resampled = []
    for belief in tools.play(localizer, scenario, [0, 1], 20).beliefs:
        torch.testing.assert_close(
            belief.log_weights.logsumexp(-1), torch.zeros(2, 6), rtol=0, atol=1e-5
        )
        figures = localizer.diagnostics(belief)
        assert (figures["particles"] == 500).all()
        assert (figures["ess_share"] > 0.99 / 500).all()
        assert (figures["ess_share"] <= 1 + 1e-5).all()
        level = belief.log_weights.amax(-1) - belief.log_weights.amin(-1) < 1e-6
        assert torch.equal(level, (figures["ess_share"] < 0.5) | (figures["ess_share"] > 0.9999))
        resampled.append(level)
    assert 0.02 < torch.stack(resampled[1:]).double().mean() < 0.98


# ---------------------------------------------------------------- impossible evidence


@pytest.mark.parametrize("tempering", ["true", "false"])
@pytest.mark.parametrize("far", [1e3, 1e6])
def test_evidence_that_no_particle_explains_leaves_a_belief(
    tempering: str, far: float, tools: SimpleNamespace
) -> None:
    """Measurements so far off that every likelihood is 0 in float32."""
    scenario = make_scenario("indoor-v0")
    localizer = make(f"pf500:tempering={tempering}", scenario)
    run = tools.play(localizer, scenario, [0], 5)
    wrong = run.observations[4]
    wrong = tools.change(wrong, landmarks=wrong["landmarks"] + far, ranges=wrong["ranges"] + far)
    belief, estimate = localizer.step(run.beliefs[4], wrong)
    assert estimate.position.isfinite().all()
    assert (torch.linalg.eigvalsh(estimate.covariance) > 0).all()
    assert belief.particles.isfinite().all()
    assert belief.log_weights.exp().isfinite().all()
    torch.testing.assert_close(
        belief.log_weights.logsumexp(-1), torch.zeros(1, 6), rtol=0, atol=1e-4
    )


def test_without_measurements_weights_do_not_move(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0")
    localizer = make("pf500", scenario)
    belief, seen = first(localizer, scenario)
    blind = {mask: torch.zeros_like(seen[mask]) for mask in tools.masked_pairs(seen)}
    after, _ = localizer.step(belief, tools.change(seen, **blind))
    torch.testing.assert_close(after.log_weights, belief.log_weights, rtol=0, atol=1e-6)
    torch.testing.assert_close(after.particles, belief.particles, rtol=0, atol=1e-6)


def test_weak_damping_leaves_the_cloud_finite(tools: SimpleNamespace) -> None:
    """In float32 the terms of a damped velocity's noise cancel to less than nothing."""
    scenario = make_scenario("indoor-v0", imu=False, landmarks=0, anchors=8)
    for damping in (10.0, 1e3, 1e6):
        damped = replace(scenario, process=ConstantVelocity(0.1, damping))
        run = tools.play(make("pf500:particles=50", damped), damped, [0], 3)
        assert run.beliefs[-1].particles.isfinite().all()
