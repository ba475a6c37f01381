"""The adaptive particle filter: its counts, its dead slots, and particles drawn under a guide."""

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from torch import Tensor

from agents import make
from agents.particle import cloud, particle_count
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.world import World
from tests.sampling import first_fast

BOUNDS = (100, 800)
VAGUE = {"landmark_std": 50.0, "uwb_std": 50.0}  # m: evidence that leaves all particles alike
WEAK = {"landmark_std": 8.0, "uwb_std": 8.0}  # evidence that still tells particles apart


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def live_slots(belief: Any) -> Tensor:
    """[B, N, M], from the counts alone."""
    return torch.arange(belief.log_weights.shape[-1]) < belief.count.unsqueeze(-1)


def errors(localizer: Any, scenario: Scenario, run: Any, seeds: Sequence[int]) -> Tensor:
    """Distances to the truth [K, B, N]."""
    world = World(scenario, len(seeds))
    world.reset(torch.tensor(list(seeds)))
    truth = []
    for estimate in run.estimates:
        truth.append(world.truth.position)
        world.advance(estimate.action())
    return (run.position.double() - torch.stack(truth)).norm(dim=-1)


# ---------------------------------------------------------------- counts


def plain_equation_17(count: int, ess: float, low: int, high: int) -> int:
    if ess < 0.3 * count:
        return min(count + 100, high)
    if ess > 0.8 * count:
        return max(count - 50, low)
    return count


@given(st.integers(100, 800), st.floats(0, 1))
@settings(deadline=None, max_examples=200)
def test_counts_follow_equation_17(count: int, share: float) -> None:
    assume(min(abs(share - 0.3), abs(share - 0.8)) > 1e-5)  # where float32 may round across
    ess = torch.tensor([[share * count]])
    found = particle_count.adapted(torch.tensor([[count]]), ess, BOUNDS)
    assert int(found) == plain_equation_17(count, float(ess), *BOUNDS)


def test_counts_between_the_thresholds_stay() -> None:
    table = [  # count, effective sample size, next count
        (300, 89.0, 400),
        (300, 91.0, 300),
        (300, 239.0, 300),
        (300, 241.0, 250),
        (750, 10.0, 800),
        (800, 10.0, 800),
        (120, 119.0, 100),
        (100, 100.0, 100),
    ]
    count, ess, after = (torch.tensor(column) for column in zip(*table, strict=True))
    assert particle_count.adapted(count[None], ess[None], BOUNDS)[0].tolist() == after.tolist()


def test_counts_grow_where_evidence_is_sharp(tools: SimpleNamespace) -> None:
    """In the room a likelihood leaves less than 0.3 of the particles at most steps."""
    scenario = make_scenario("indoor-v0")
    beliefs = tools.play(make("apf", scenario), scenario, [0, 1], 80).beliefs
    counts = torch.stack([belief.count for belief in beliefs])
    assert (counts[0] == 300).all()
    assert (counts.amax(0) == 800).all()
    assert counts[60:].double().mean() > 700
    assert set(counts.diff(dim=0).unique().tolist()) <= {-50, 0, 50, 100}


def test_counts_shrink_where_particles_agree(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", **VAGUE, believed_uwb_std=50.0)
    beliefs = tools.play(make("apf", scenario), scenario, [0, 1], 25).beliefs
    counts = torch.stack([belief.count for belief in beliefs])
    assert (counts.diff(dim=0)[:3] == -50).all()
    assert (counts[-1] == 100).all()


def test_counts_without_bounds_stay(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0")
    for belief in tools.play(make("pf500", scenario), scenario, [0], 6).beliefs:
        assert (belief.count == 500).all()


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        ({"bounds": (400, 800)}, r"bounds=\(400, 800\) is not allowed"),
        ({"bounds": (100, 200)}, r"particles \(300\)"),
        ({"bounds": (9, 800)}, "2 numbers from 10 to 100000"),
        ({"particles": 900}, r"particles \(900\)"),
        ({"particles": 9, "bounds": None}, "a whole number from 10 to 100000"),
    ],
)
def test_bounds_that_do_not_hold_the_count_are_refused(chosen: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words) as error:
        make("apf", make_scenario("indoor-v0"), **chosen)
    assert "\n" not in str(error.value)


def test_bounds_come_in_the_name() -> None:
    localizer: Any = make("apf:particles=50:bounds=20,60", make_scenario("indoor-v0"))
    assert (localizer.particles, localizer.bounds, localizer.capacity) == (50, (20, 60), 60)


# ---------------------------------------------------------------- live and dead


def test_live_particles_are_weighed_and_dead_ones_are_not(tools: SimpleNamespace) -> None:
    for overrides in ({}, VAGUE):
        scenario = make_scenario("indoor-v0", **overrides)
        for belief in tools.play(make("apf", scenario), scenario, [0, 1, 2], 12).beliefs:
            live = live_slots(belief)
            assert ((belief.count >= 100) & (belief.count <= 800)).all()
            assert (belief.log_weights[~live] == -math.inf).all()
            assert belief.log_weights[live].isfinite().all()
            total = belief.log_weights.double().exp().sum(-1)
            torch.testing.assert_close(total, torch.ones_like(total), rtol=0, atol=1e-5)
            assert belief.particles.isfinite().all()
            assert (belief.ess_share > 0).all()
            assert (belief.ess_share < 1 + 1e-5).all()


@pytest.mark.parametrize("name", ["apf", "apf:proposal=ekf", "apf:robust=huber", "pfnn"])
@pytest.mark.parametrize("k", [1, 8])
def test_dead_slots_never_matter(name: str, k: int, tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0")
    localizer = make(name, scenario)
    run = tools.play(localizer, scenario, [0, 1], k + 1)
    belief = run.beliefs[k].clone()
    live = live_slots(belief)
    assert not live.all()
    rubbish = 30 * torch.randn(belief.particles.shape, generator=generator())
    belief.particles = torch.where(live.unsqueeze(-1), belief.particles, rubbish)
    after, estimate = localizer.step(belief, run.observations[k])
    tools.assert_same(estimate, run.estimates[k])
    tools.assert_same(after, run.beliefs[k + 1])


def test_heaviest_first_orders_those_asked_for() -> None:
    particles = torch.randn(2, 3, 40, 6, generator=generator())
    log_weights = torch.randn(2, 3, 40, generator=generator(1))
    log_weights[..., 30:] = -math.inf
    rows = torch.tensor([[True, False, True], [False, False, True]])
    moved, kept = particle_count.heaviest_first(particles, log_weights, rows)
    for b in range(2):
        for n in range(3):
            order = list(range(40))
            if rows[b, n]:
                order.sort(key=lambda i: -float(log_weights[b, n, i]))
            assert torch.equal(moved[b, n], particles[b, n, order])
            assert torch.equal(kept[b, n], log_weights[b, n, order])


def test_the_heaviest_are_kept_as_they_are(tools: SimpleNamespace) -> None:
    """A count that falls only leaves light particles out; ``bounds`` that forbid it show them."""
    scenario = make_scenario("indoor-v0", **WEAK, believed_uwb_std=8.0)
    shrinks, stays = (make("apf", scenario, bounds=(low, 800)) for low in (100, 300))
    run = tools.play(shrinks, scenario, [0, 1], 1)
    found = run.beliefs[1]
    whole, _ = stays.step(run.beliefs[0], run.observations[0])
    assert (whole.count == 300).all()
    shrunk = (found.count == 250).nonzero().tolist()
    assert len(shrunk) >= 3
    for b, n in shrunk:
        weights = whole.log_weights[b, n, :300]
        order = weights.argsort(descending=True, stable=True)[:250]
        assert order.tolist() != list(range(250))
        assert torch.equal(found.particles[b, n, :250], whole.particles[b, n, order])
        expected = weights[order].double().log_softmax(-1).float()
        torch.testing.assert_close(found.log_weights[b, n, :250], expected, rtol=0, atol=1e-6)


def test_rows_of_differing_counts_are_their_own_runs(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0")
    localizer = make("apf", scenario)
    many = tools.play(localizer, scenario, range(5), 12)
    counts = many.beliefs[-1].count
    assert len(counts.amax(-1).unique()) > 1  # or batches would work on as many slots as rows do
    for seed in range(5):
        alone = tools.play(localizer, scenario, [seed], 12)
        for one, other in zip(alone.estimates, many.estimates, strict=True):
            tools.assert_same(one, other[seed : seed + 1])
        tools.assert_same(alone.beliefs[-1], many.beliefs[-1][seed : seed + 1])


# ---------------------------------------------------------------- resampling with counts


def test_resampling_to_another_count_is_unbiased() -> None:
    m, draws = 50, 4000
    w = torch.rand(m, generator=generator()) ** 3
    w[40:] = 0.0
    offsets = (torch.arange(draws) + 0.5) / draws
    for count in (7, 33, 50):
        rungs = torch.full((1, draws), count)
        index = cloud.systematic(w.expand(1, draws, m), offsets.unsqueeze(0), rungs)[..., :count]
        counts = torch.nn.functional.one_hot(index, m).double().sum(-2)
        mean = count * w.double() / w.double().sum()
        assert ((counts - mean).abs() < 1 + 1e-4).all()
        torch.testing.assert_close(counts.mean((0, 1)), mean, rtol=0, atol=2e-3)


def test_each_uav_is_resampled_to_its_own_count() -> None:
    w = torch.rand(2, 3, 40, generator=generator())
    offset = torch.rand(2, 3, generator=generator(1))
    count = torch.tensor([[10, 20, 40], [11, 39, 1]])
    together = cloud.systematic(w, offset, count)
    for b in range(2):
        for n in range(3):
            k = int(count[b, n])
            alone = cloud.systematic(w[b, n].view(1, 1, -1), offset[b, n].view(1, 1), count[b, n])
            assert torch.equal(together[b, n, :k], alone[0, 0, :k])
            rungs = (torch.arange(k) + offset[b, n].double()) / k
            share = w[b, n].double().cumsum(-1) / w[b, n].double().sum()
            assert torch.equal(together[b, n, :k], torch.searchsorted(share, rungs, right=True))


# ---------------------------------------------------------------- drawn under a guide


def lied_to(localizer: Any, far: float, which: slice, seeds: list[int], tools: Any) -> Tensor:
    """Errors [K, B, N] of a run of 60 steps in which, at the twelfth, landmarks of some numbers are
    seen ``far`` m off; whatever is believed of it, beliefs must stay finite."""
    scenario, lies = make_scenario("indoor-v0"), 12
    seen = list(tools.play(localizer, scenario, seeds, 60).observations)
    landmarks = seen[lies]["landmarks"].unflatten(-1, (-1, 3)).clone()
    landmarks[..., which, :] += far
    seen[lies] = tools.change(seen[lies], landmarks=landmarks.flatten(-2))
    run = tools.replay(localizer, seen)
    for belief, estimate in zip(run.beliefs[1:], run.estimates, strict=True):
        assert belief.particles.isfinite().all()
        assert estimate.position.isfinite().all()
        assert (torch.linalg.eigvalsh(estimate.covariance.double()) > 0).all()
    return errors(localizer, scenario, run, seeds)


@pytest.mark.slow
def test_all_landmarks_may_be_far_off_for_a_step(tools: SimpleNamespace) -> None:
    """Over 9 worlds the lie costs 0.4 m in the mean; after 47 honest steps 0.07 m are left at most,
    as without it."""
    error = lied_to(make("apf", make_scenario("indoor-v0")), 1.0, slice(None), [0, 1, 2], tools)
    assert error[11].max() < 0.3
    assert error[12].mean() > 0.2  # it was believed
    assert error[-1].max() < 0.15


@pytest.mark.parametrize("far", first_fast(50.0, 1e4))
def test_a_landmark_may_be_very_far_off_for_a_step(far: float, tools: SimpleNamespace) -> None:
    """No particle can follow: the guide's posterior is drawn, and left again when it is wrong (an
    EKF takes as long). Over 9 worlds, 0.01 to 0.06 of the error is left after 47 honest steps."""
    error = lied_to(make("apf", make_scenario("indoor-v0")), far, slice(0, 7), [0, 1, 2], tools)
    assert error[12].max() > 2.0
    assert error[-1].mean() < 0.25 * error[12].mean()


# In the linear world, where the Kalman filter is the answer, each UAV measures its own position.


def fixes(world: Any, steps: int) -> list[Observation]:
    """Fixes of UAVs near the origin of two worlds; ``prior`` is the filters' own."""
    g, team = generator(4), world.believed
    n, d = team.arena.n_uavs, team.arena.dim
    std = torch.tensor([team.prior.position_std] * d + [team.prior.velocity_std, 0.05])
    mean = torch.cat((torch.randn(2, n, 2 * d, generator=g), torch.zeros(2, n, 4)), -1)
    prior = torch.cat((mean, std.expand(2, n, -1)), -1)
    silent = {"messages": torch.zeros(2, n, n * 3 * d)}
    silent |= {name: torch.zeros(2, n, n) for name in ("message_mask", "links")}
    return [
        Observation(
            {
                "prior": prior,
                "fix": mean[..., :d] + 1.2 * torch.randn(2, n, d, generator=g),
                "fix_mask": torch.ones(2, n, 1),
                **silent,
            }
        )
        for _ in range(steps)
    ]


def test_guided_particles_have_exact_weights(
    monkeypatch: pytest.MonkeyPatch, tools: SimpleNamespace
) -> None:
    """Drawn from 1.1 × the posterior P, weights are those of N(P) against N(1.1 P): the posterior
    comes out, not 1.1 × it, and of the count M (√(2·1.1 − 1) / 1.1)ᴱ M are effective."""
    world = tools.linear
    for module in ("kalman.ekf", "particle.filter"):
        monkeypatch.setattr(f"agents.{module}.make_measurements", lambda _: [world.fixes])
    seen = fixes(world, 5)
    kalman = tools.replay(make("ekf", world), seen)
    guided = tools.replay(make("pf500:particles=20000:proposal=ekf", world), seen)
    for ours, exact in zip(guided.estimates, kalman.estimates, strict=True):
        std = exact.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        assert ((ours.position - exact.position) / std).abs().max() < 0.05
        apart = ours.covariance - exact.covariance
        assert (apart / (std.unsqueeze(-1) * std.unsqueeze(-2))).abs().max() < 0.06
    share = torch.stack([belief.ess_share for belief in guided.beliefs[1:]])
    expected = (math.sqrt(2 * 1.1 - 1) / 1.1) ** (2 * world.believed.arena.dim)
    assert (share - expected).abs().max() < 0.01


# ---------------------------------------------------------------- compiled


@pytest.mark.slow
def test_a_compiled_filter_says_the_same(tools: SimpleNamespace) -> None:
    """In every step from the same belief once the start is over; there, last digits choose other
    ancestors between the stages of a likelihood, as they do over a run (measured: 1e-5 m)."""
    scenario = make_scenario("indoor-v0", n_uavs=2)
    run = tools.play(make("apf", scenario), scenario, [0, 1], 10)
    compiled = make("apf:compile=true", scenario)
    for k in range(3, 10):
        after, estimate = compiled.step(run.beliefs[k], run.observations[k])
        expected = run.estimates[k]
        torch.testing.assert_close(estimate.position, expected.position, rtol=0, atol=1e-4)
        torch.testing.assert_close(estimate.covariance, expected.covariance, rtol=0, atol=1e-4)
        assert torch.equal(after.count, run.beliefs[k + 1].count)
