"""Multidimensional scaling as others have it (dwMDS, vMDS, FC-MDS): against scipy and
scikit-learn, and in networks that leave UAVs without a place."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from agents import make
from agents.swarm import delays, window
from agents.swarm.belief import Prepared, SwarmBelief, begun
from agents.swarm.calibration import believed_model
from agents.swarm.fcmds import completed
from agents.swarm.filter import SwarmFilter
from agents.swarm.gauss_newton import fisher
from agents.swarm.links import Links, connected, lengths
from agents.swarm.majorization import majorizer, nodewise, own_pull, stress
from agents.swarm.persistence import believed_chain
from agents.swarm.scaling import classical_scaling
from agents.swarm.spread import spread, told
from agents.swarm.weights import loess
from coloc_env.observation import Observation
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

STD = 10.0
METHODS = ("dwmds", "vmds", "fcmds")
SMALL: dict[str, Any] = {"n_uavs": 30, "anchor_share": 0.3, "ins_bias": 0.0, "comm_radius": 6000.0}


def team(seed: int, n: int = 14, worlds: int = 2, reach: float = 800.0) -> Prepared:
    """Random places in a cube of 1 km, noisy ranges within reach, five who are fixed, the others'
    places dead-reckoned to 30 m."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    place = 1000 * torch.rand(worlds, n, 3, generator=generator, dtype=torch.float64)
    true = lengths(place)
    mask = true < reach
    mask.diagonal(dim1=-2, dim2=-1).fill_(False)
    noise = torch.triu(normal(worlds, n, n), 1)
    fixed = torch.zeros(worlds, n, dtype=torch.bool)
    fixed[:, :5] = True
    place_now = torch.where(fixed.unsqueeze(-1), place, place + 30 * normal(worlds, n, 3))
    variance = torch.where(fixed, 0.01, 900.0).double()
    return Prepared(
        state=torch.cat((place_now, torch.zeros_like(place)), -1),
        place=place_now,
        variance=variance,
        added=torch.zeros_like(variance),
        reckoned=variance,
        joint=variance.new_zeros(worlds, n, 1, 0),
        between=variance.unsqueeze(-1) + variance.unsqueeze(-2),
        drift=None,
        delays=delays.begun(place, None),
        chain=believed_chain(torch.full((worlds,), 0.1, dtype=torch.float64)),
        fixed=fixed,
        links=Links((true + STD * (noise + noise.mT)) * mask, mask),
        model=believed_model(worlds, STD, torch.device("cpu")),
    )


def method(agent: str) -> SwarmFilter:
    localizer = make(agent, make_scenario("swarm-v0"))
    assert isinstance(localizer, SwarmFilter)
    return localizer


def belief(now: Prepared, step: int = 1) -> SwarmBelief:
    """All that the three look at: the count of steps."""
    shape = now.fixed.shape
    return SwarmBelief(
        state=torch.cat((now.place, now.place), -1),
        variance=now.variance,
        joint=now.joint,
        bias=torch.zeros_like(now.place),
        drift=torch.zeros_like(now.place[..., :2]),
        chain=now.chain.unsqueeze(1).expand(-1, shape[1], -1, -1),
        memory=now.variance.new_zeros(*shape, 0),
        localizable=now.fixed,
        step=torch.full(shape, step),
        errors=now.model.sums.unsqueeze(1).expand(-1, shape[1], -1, -1),
        past=window.begun(now.place, now.joint, 0),
        delays=now.delays,
        batch_size=shape,
    )


def minimum(now: Prepared, weight: Tensor, trust: Tensor) -> np.ndarray:
    """Where scipy finds the least stress of the first world, from where dead reckoning is."""
    free = ~now.fixed[0]

    def cost(flat: np.ndarray) -> tuple[float, np.ndarray]:
        moved = torch.from_numpy(flat).view(-1, 3).requires_grad_(True)
        y = now.place[:1].clone()
        y = y.index_put((torch.zeros(int(free.sum()), dtype=torch.int64), free.nonzero()[:, 0]),
                        moved)  # fmt: skip
        value = stress(y, now.links.distance[:1], weight[:1], now.place[:1], trust[:1]).sum()
        value.backward()
        assert moved.grad is not None
        return float(value.detach()), moved.grad.numpy().ravel()

    start = now.place[0, free].numpy().ravel()
    best = minimize(cost, start, jac=True, method="BFGS", options={"gtol": 1e-9, "maxiter": 5000})
    return best.x.reshape(-1, 3)


# ---------------------------------------------------------------- the least stress


@pytest.mark.parametrize("prior_weight", [0.0, 1.0])
def test_dwmds_ends_where_scipy_finds_the_least_stress(prior_weight: float) -> None:
    now = team(1)
    agent = f"dwmds:bandwidth=1:prior_weight={prior_weight}:iterations=4000:first=4000"
    found = method(agent).find(belief(now), now)
    weight = loess(now.links.distance, now.links.mask, 1.0) / STD**2
    trust = torch.where(now.fixed, 0.0, prior_weight / now.variance)
    best = minimum(now, weight, trust)
    np.testing.assert_allclose(found.position[0, ~now.fixed[0]], best, atol=1e-2)


@pytest.mark.parametrize("step", [0, 1])
def test_vmds_ends_where_scipy_finds_the_least_stress(step: int) -> None:
    now = team(2)
    agent = "vmds:velocity_weight=0.02:confidence=none:iterations=2000:first=2000"
    found = method(agent).find(belief(now, step), now)
    weight = now.links.mask.double() / STD**2
    trust = torch.where(now.fixed, 0.0, 0.02 if step else 1 / now.variance)
    best = minimum(now, weight, trust)
    np.testing.assert_allclose(found.position[0, ~now.fixed[0]], best, atol=1e-2)


def test_fcmds_ends_where_scipy_finds_the_least_stress() -> None:
    now = team(3)
    found = method("fcmds:iterations=4000:first=4000").find(belief(now), now)
    best = minimum(now, now.links.mask.double() / STD**2, torch.zeros_like(now.variance))
    np.testing.assert_allclose(found.position[0, ~now.fixed[0]], best, atol=1e-2)


def test_the_velocity_term_is_that_of_dead_reckoning() -> None:
    """λ_s ‖(p(t) − p(t−1))/Δt − v‖² = λ_s/Δt² ‖p(t) − (p(t−1) + v Δt)‖²: half the
    step in time, four times the weight in space."""
    now = team(4)
    slow = method("vmds:velocity_weight=0.04")
    fast = make("vmds:velocity_weight=0.01", make_scenario("swarm-v0", dt=0.5))
    assert isinstance(fast, SwarmFilter)
    one, other = (x.find(belief(now), now).position for x in (slow, fast))
    assert torch.allclose(one, other, atol=1e-9)


@given(st.integers(0, 1000), st.floats(300.0, 1800.0), st.floats(0.0, 1e-2))
@settings(max_examples=15, deadline=None)
def test_sweeps_never_raise_the_stress(seed: int, reach: float, held: float) -> None:
    now = team(seed, reach=reach)
    weight = loess(now.links.distance, now.links.mask, 1.0) / STD**2
    trust = torch.full_like(now.variance, held).masked_fill(now.fixed, 0.0)
    parts = (now.links.distance, weight, now.place, trust)
    y = now.place + 100.0 * ~now.fixed.unsqueeze(-1)
    before = stress(y, *parts)
    for _ in range(20):
        y = nodewise(y, *parts, now.fixed)
        after = stress(y, *parts)
        assert (after <= before * (1 + 1e-12)).all()
        before = after
    assert torch.equal(y[now.fixed], now.place[now.fixed])


@given(st.integers(0, 1000), st.floats(300.0, 1800.0), st.booleans())
@settings(max_examples=15, deadline=None)
def test_completing_never_raises_the_stress_of_what_was_measured(
    seed: int, reach: float, anchored: bool
) -> None:
    now = team(seed, reach=reach)
    fixed = now.fixed if anchored else torch.zeros_like(now.fixed)
    weight, nothing = now.links.mask.double(), torch.zeros_like(now.variance)
    together = connected(now.links.mask)
    y = now.place + 100.0 * torch.sin(now.place)
    before = stress(y, now.links.distance, weight, y, nothing)
    for _ in range(20):
        y = completed(y, now.links.distance, now.links.mask, together, fixed)
        after = stress(y, now.links.distance, weight, y, nothing)
        assert (after <= before * (1 + 1e-12)).all()
        before = after


def test_the_sweeps_diagonal_is_no_less_than_the_laplacian() -> None:
    now = team(5)
    weight = now.links.mask.double()
    factor = majorizer(weight, torch.zeros_like(now.variance), now.fixed)
    laplacian = factor @ factor.mT
    bound = own_pull(weight, now.fixed).masked_fill(now.fixed, 1.0)
    assert (torch.linalg.eigvalsh(torch.diag_embed(bound) - laplacian) > -1e-9).all()


def test_without_anchors_and_with_all_distances_fcmds_is_scikit_learns() -> None:
    """Its SMACOF minimizes the same stress of a fully connected network."""
    manifold = pytest.importorskip("sklearn.manifold")
    now = team(6, worlds=1, reach=2000.0)
    distance = now.links.distance
    start = classical_scaling(distance, 3)
    nobody, all_of_them = torch.zeros_like(now.fixed), connected(now.links.mask)
    y = start
    for _ in range(2000):
        y = completed(y, distance, now.links.mask, all_of_them, nobody)
    _, best = manifold.smacof(
        distance[0].numpy(), n_components=3, init=start[0].numpy(), n_init=1, max_iter=3000,
        eps=1e-12, normalized_stress=False,
    )  # fmt: skip
    nothing = torch.zeros_like(now.variance)
    found = stress(y, distance, now.links.mask.double(), y, nothing)
    assert float(found) == pytest.approx(best, rel=1e-5)


def test_connected_parts_are_scipys() -> None:
    now = team(7, n=30, reach=250.0)
    found = connected(now.links.mask)
    for one, mask in zip(found, now.links.mask, strict=True):
        count, label = connected_components(mask.numpy(), directed=False)
        assert count > 3
        np.testing.assert_array_equal(one, label[:, None] == label[None])


def test_loess_weights_are_one_near_by_and_less_far_off() -> None:
    distance = torch.tensor([[[0.0, 3.0, 0.0], [3.0, 0.0, 6.0], [0.0, 6.0, 0.0]]]).double()
    mask = distance > 0
    found = loess(distance, mask, 1.0)
    assert found[0, 0, 1] == pytest.approx(math.exp(-0.25))  # h: 6, the longest at either end
    assert found[0, 1, 2] == pytest.approx(math.exp(-1))
    assert torch.equal(loess(distance, mask, math.inf), mask.double())
    assert torch.equal(loess(0 * distance, mask & False, 1.0), torch.zeros_like(distance))


# ---------------------------------------------------------------- how sure


def test_what_anchors_tell_is_fishers_information() -> None:
    """A UAV whose neighbours are all fixed: exactly."""
    now = team(8, worlds=1, n=6, reach=2000.0)
    weight, variance = now.links.mask.double() / STD**2, torch.zeros_like(now.variance)
    exact = lengths(now.place) * now.links.mask
    found = told(now.place, exact, weight, now.fixed, variance, STD)
    expected = fisher(now.place, weight)[0, 5, :, 5]
    assert torch.allclose(found[0, 5], expected, rtol=1e-8)
    sure = spread(found, torch.full_like(variance, 1e-9), torch.ones_like(variance), now.fixed)
    expected_variance = torch.linalg.inv(expected).diagonal().mean()
    assert float(sure[0, 5]) == pytest.approx(float(expected_variance), rel=1e-4)


def test_larger_residuals_tell_less() -> None:
    now = team(9)
    weight = now.links.mask.double()
    parts = (weight, now.fixed, now.variance, STD)
    exact = lengths(now.place)
    good, bad = (told(now.place, d * now.links.mask, *parts) for d in (exact, exact + 40.0))
    assert (torch.linalg.eigvalsh(good - bad)[~now.fixed] > -1e-12).all()
    assert (good - bad)[~now.fixed].flatten(1).norm(dim=-1).min() > 0


def test_without_anchors_ranges_tell_nothing() -> None:
    now = team(10)
    nobody = torch.zeros_like(now.fixed)
    weight = now.links.mask.double() / STD**2
    found = told(now.place, now.links.distance, weight, nobody, now.variance, STD)
    variance = spread(found, torch.ones_like(now.variance), now.variance, nobody)
    assert torch.allclose(variance, now.variance)


def test_the_spread_of_a_weighted_mean() -> None:
    """By simulation: a start off by N(0, P), ranges that tell J, a mean with weights λ and J."""
    generator = torch.Generator().manual_seed(0)
    j, held, p = 0.04, 0.01, 50.0
    start, told_by = torch.randn(2, 200_000, generator=generator, dtype=torch.float64)
    off = (held * p**0.5 * start + j * told_by / j**0.5) / (held + j)
    one = torch.ones(1, 1, dtype=torch.float64)
    found = spread(j * torch.eye(3).double()[None, None], held * one, p * one, one < 0)
    assert float(found) == pytest.approx(float(off.square().mean()), rel=0.02)


# ---------------------------------------------------------------- whole steps


def permuted(now: Prepared, order: Tensor) -> Prepared:
    return replace(
        now,
        place=now.place[:, order],
        variance=now.variance[:, order],
        reckoned=now.reckoned[:, order],
        between=now.between[:, order][:, :, order],
        fixed=now.fixed[:, order],
        links=Links(
            now.links.distance[:, order][:, :, order], now.links.mask[:, order][:, :, order]
        ),
    )


@pytest.mark.parametrize("agent", [*METHODS, "fcmds:start=paths", "dwmds:reach=600"])
def test_names_of_uavs_do_not_matter(agent: str) -> None:
    now = team(11)
    order = torch.randperm(14, generator=torch.Generator().manual_seed(1))
    found, again = (method(agent).find(belief(x), x) for x in (now, permuted(now, order)))
    assert torch.allclose(found.position[:, order], again.position, atol=1e-6)
    assert torch.allclose(found.variance[:, order], again.variance, rtol=1e-6)


def test_reach_drops_neighbours_that_are_far_by_dead_reckoning() -> None:
    now = team(12)
    near = lengths(now.place) <= 500.0
    fewer = replace(now, links=Links(now.links.distance * near, now.links.mask & near))
    found = method("dwmds:reach=500:bandwidth=inf").find(belief(now), now)
    expected = method("dwmds:bandwidth=inf").find(belief(now), fewer)
    assert torch.equal(found.position, expected.position)
    everybody = method("dwmds:bandwidth=inf").find(belief(now), now)
    assert not torch.equal(found.position, everybody.position)


@pytest.mark.parametrize("agent", [*METHODS, "fcmds:start=paths"])
def test_a_prior_that_is_no_number_is_made_up_for_by_ranges(agent: str) -> None:
    now = team(13, reach=2000.0)
    place = now.place.clone()
    place[0, 9] = torch.nan
    off = place.clone()
    localizer, lost = method(agent), replace(now, place=place)
    for _ in range(40):
        found = localizer.find(belief(lost, 0), lost)
        between = found.variance.unsqueeze(-1) + found.variance.unsqueeze(-2)
        lost = replace(lost, place=found.position, variance=found.variance, between=between)
    usual = localizer.find(belief(now, 0), now)
    for _ in range(39):
        usual = localizer.find(
            belief(now, 0),
            replace(
                now,
                place=usual.position,
                variance=usual.variance,
                between=usual.variance.unsqueeze(-1) + usual.variance.unsqueeze(-2),
            ),
        )
    assert found.position.isfinite().all()
    assert found.variance.isfinite().all()
    assert torch.allclose(found.position[1], usual.position[1], atol=1e-9)
    assert (found.position[0, 9] - usual.position[0, 9]).norm() < 60.0
    assert off[0, 9].isnan().all()  # not written to


def test_who_has_no_place_and_no_neighbour_begins_in_the_middle() -> None:
    now = team(14, worlds=1)
    place, mask = now.place.clone(), now.links.mask.clone()
    place[0, 9] = torch.nan
    mask[0, 9] = mask[0, :, 9] = False
    found = begun(replace(now, place=place, links=Links(now.links.distance, mask)))
    others = torch.arange(14) != 9
    assert torch.allclose(found.place[0, 9], place[0, others].mean(0))
    assert found.variance[0, 9] > 1e9
    assert torch.equal(found.variance[0, others], now.variance[0, others])


def flown(agent: str, steps: int = 6, **overrides: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Errors, positions and covariances of one world, step by step."""
    scenario = make_scenario("swarm-v0", **SMALL | overrides)
    localizer, world = make(agent, scenario), World(scenario, 1)
    observation = world.reset(torch.tensor([0]))
    now, found = localizer.reset(observation), []
    for _ in range(steps):
        now, estimate = localizer.step(now, observation)
        error = (estimate.position - world.truth.position).norm(dim=-1)
        found.append((error, estimate.position, estimate.covariance))
        world.advance(estimate.action())
        observation = world.observation()
    error, position, covariance = (torch.stack(x) for x in zip(*found, strict=True))
    return error, position, covariance


@pytest.mark.parametrize("agent", METHODS)
def test_they_localize(agent: str) -> None:
    error, _, _ = flown(agent, 15, nlos=0.0)
    reckoned, _, _ = flown("dead_reckoning", 15, nlos=0.0)
    guides = 9
    assert error[5:, :, guides:].square().mean().sqrt() < 12.0
    assert reckoned[5:, :, guides:].square().mean().sqrt() > 60.0


@pytest.mark.parametrize("agent", [*METHODS, "fcmds:start=paths", "dwmds:prior_weight=0"])
@pytest.mark.parametrize(
    "overrides",
    [
        {"comm_radius": 1.0},  # nobody hears anybody
        {"comm_radius": 1500.0},  # in pieces, some without an anchor
        {"anchor_share": 0.0},
        {"link_failure": 1.0},
        {"n_uavs": 1, "anchor_share": 0.0},
        {"n_uavs": 2, "anchor_share": 0.5},
        {"failure_rate": 1.0, "horizon": 4},
    ],
    ids=str,
)
def test_no_network_is_too_broken(agent: str, overrides: dict[str, Any]) -> None:
    _, position, covariance = flown(agent, 4, **overrides)
    assert position.isfinite().all()
    assert (torch.linalg.eigvalsh(covariance) > 0).all()


@pytest.mark.parametrize("agent", METHODS)
def test_who_hears_nobody_dead_reckons_and_says_how_unsure_it_is(agent: str) -> None:
    _, alone, covariance = flown(agent, comm_radius=1.0)
    _, reckoned, expected = flown("dead_reckoning", comm_radius=1.0)
    guides = 9
    assert torch.allclose(alone[..., guides:, :], reckoned[..., guides:, :], atol=1e-3)
    assert torch.allclose(covariance[:, :, guides:], expected[:, :, guides:], rtol=1e-4)


@pytest.mark.parametrize("agent", METHODS)
def test_a_team_without_anchors_grows_ever_less_sure(agent: str) -> None:
    _, _, covariance = flown(agent, anchor_share=0.0)
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    assert (variance.diff(dim=0)[1:] > 0).all()
    assert (variance[-1] >= 2500.0).all()


@pytest.mark.parametrize(
    ("agent", "words"),
    [
        ("dwmds:bandwidth=0", "bandwidth=0.0 is not allowed"),
        ("dwmds:prior_weight=-1", "prior_weight=-1.0 is not allowed"),
        ("dwmds:prior_weight=inf", "prior_weight=inf is not allowed"),
        ("dwmds:reach=0", "reach=0.0 is not allowed"),
        ("dwmds:iterations=0", "iterations=0, first=60 is not allowed"),
        ("vmds:velocity_weight=0", "velocity_weight=0.0 is not allowed"),
        ("vmds:iterations=31", "iterations=31, first=30 is not allowed"),
        ("fcmds:iterations=0", "iterations=0, first=60 is not allowed"),
        ("fcmds:start=here", "start='here' is not allowed"),
    ],
)
def test_wrong_options(agent: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make(agent, make_scenario("swarm-v0"))


def test_observations_without_any_number_do_not_stop_anybody() -> None:
    scenario = make_scenario("swarm-v0", **SMALL)
    world = World(scenario, 1)
    first = world.reset(torch.tensor([0]))
    blank = Observation({k: torch.full_like(v, torch.nan) if k == "prior" else v
                         for k, v in first.leaves.items()})  # fmt: skip
    for agent in METHODS:
        localizer = make(agent, scenario)
        _, estimate = localizer.step(localizer.reset(blank), blank)
        assert estimate.position.isfinite().all()
        assert estimate.covariance.isfinite().all()
