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
    found = tools.score("pf800", scenario, 6, 120)
    assert 0.95 < found.rmse / posterior_bound(scenario, 6, 0, 120).rmse < 1.25
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


# ---------------------------------------------------------------- as printed


def test_the_printed_filter_starts_anywhere() -> None:
    scenario = make_scenario("indoor-v0")
    belief, _ = first(make("pf800:variant=paper:particles=4000", scenario), scenario)
    place = belief.particles[..., :3] / torch.tensor(ROOM)
    counts = torch.stack([torch.histc(place[0, 0, :, axis], 10, 0, 1) for axis in range(3)])
    assert (counts / 400 - 1).abs().max() < 0.25
    assert (belief.last[..., :3] / torch.tensor(ROOM) - 0.5).abs().max() < 0.03  # not the prior's


def test_the_printed_filter_depends_on_its_perturbation(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0")
    usual, wide = (
        tools.score(f"pf500:variant=paper:perturb_std={std}", scenario, 3, 100) for std in (0.1, 1)
    )
    assert usual.rmse_per_run.max() < 0.3
    assert wide.rmse_per_run.min() > 0.3
    assert wide.rmse_per_run.max() < 0.8


def algorithm_2(count: int, ess: float) -> int:
    """Inside Algorithm 1's test, where its second branch cannot be."""
    return min(count + 100, 800) if ess < 0.5 * count and ess < 0.3 * count else count


def test_resampling_is_algorithm_2(tools: SimpleNamespace) -> None:
    """Without perturbation: copies of live particles, new ones copies of resampled ones."""
    scenario = make_scenario("indoor-v0")
    localizer: Any = make("apf:variant=paper:perturb_std=1e-9", scenario)
    belief, _ = first(localizer, scenario)
    g = torch.Generator().manual_seed(1)
    seen = []
    for scale in (0.1, 1.0, 6.0):  # of log-weights: many, some and few effective particles
        weights = belief.log_weights + scale * torch.randn(belief.log_weights.shape, generator=g)
        resampling = localizer.resampling
        weighed = resampling.weigh(belief.particles, weights, belief.count)
        particles, after = resampling.next_particles(
            belief.particles, weighed, belief.count, belief.key
        )
        for b, n in ((0, 0), (1, 3)):
            ess, target = float(weighed.ess[b, n]), int(weighed.target[b, n])
            assert target == algorithm_2(300, ess)
            seen.append((target, ess < 150))
            if ess < 150:
                new, old = particles[b, n, :target, :3], belief.particles[b, n, :300, :3]
                assert (new.unsqueeze(1) - old).norm(dim=-1).amin(-1).max() < 1e-4
                kept = after[b, n, :target].exp()
                torch.testing.assert_close(kept, torch.full_like(kept, 1 / target))
            else:
                assert torch.equal(particles[b, n, :300], belief.particles[b, n, :300])
    assert {target for target, _ in seen} == {300, 400}
    assert {few for _, few in seen} == {True, False}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("pf500:variant=paper:perturb=fixed", "variant=paper takes no perturb"),
        ("apf:variant=paper:robust=huber", "variant=paper takes no perturb, renewal, proposal"),
        ("pfnn:perturb_std=0.2", "with variant=paper only"),
        ("pf_trust:variant=paper", "trusts all measurements alike"),
    ],
)
def test_what_the_printed_filter_has_not_is_refused(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words) as error:
        make(text, make_scenario("indoor-v0"))
    assert "\n" not in str(error.value)


def test_redraws_are_counted(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", false_matches=0.1)

    def share(name: str) -> float:
        localizer = make(name, scenario)
        run = tools.play(localizer, scenario, [0, 1], 15)
        return float(torch.stack([b.renewed.float() for b in run.beliefs[4:]]).mean())

    assert share("pf500") > 0.5
    assert share("pf500:renewal=none") == share("pf500:variant=paper") == 0.0
    assert share("pf500:proposal=ekf") == 1.0


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
