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
from agents.swarm import delays, ins_bias, joint_bias, window
from agents.swarm.belief import StepInput, SwarmBelief, with_finite_prior
from agents.swarm.calibration import prior_model
from agents.swarm.fcmds import completed_step
from agents.swarm.filter import SwarmFilter
from agents.swarm.gauss_newton import fisher
from agents.swarm.links import Links, connected, lengths
from agents.swarm.majorization import jacobi_diagonal, jacobi_step, majorizer, stress
from agents.swarm.persistence import prior_counts
from agents.swarm.scaling import classical_scaling
from agents.swarm.uncertainty import anchor_information, position_variance
from agents.swarm.weights import loess
from coloc_env.observation import Observation
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

STD = 10.0
METHODS = ("dwmds", "vmds", "fcmds")
SMALL: dict[str, Any] = {"n_uavs": 30, "anchor_share": 0.3, "ins_bias": 0.0, "comm_radius": 6000.0}


def team(seed: int, n: int = 14, worlds: int = 2, reach: float = 800.0) -> StepInput:
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
    prior = torch.where(fixed.unsqueeze(-1), place, place + 30 * normal(worlds, n, 3))
    variance = torch.where(fixed, 0.01, 900.0).double()
    return StepInput(
        state=torch.cat((prior, torch.zeros_like(place)), -1),
        prior=prior,
        variance=variance,
        process_noise=torch.zeros_like(variance),
        predicted_variance=variance,
        joint=variance.new_zeros(worlds, n, 1, 0),
        pair_variance=variance.unsqueeze(-1) + variance.unsqueeze(-2),
        ins_bias=None,
        delays=delays.initial(place, None),
        transitions=prior_counts(torch.full((worlds,), 0.1, dtype=torch.float64)),
        fixed=fixed,
        links=Links((true + STD * (noise + noise.mT)) * mask, mask),
        error_model=prior_model(worlds, STD, torch.device("cpu")),
    )


def method(agent: str) -> SwarmFilter:
    localizer = make(agent, make_scenario("swarm-v0"))
    assert isinstance(localizer, SwarmFilter)
    return localizer


def belief(inputs: StepInput, step: int = 1) -> SwarmBelief:
    """A belief of which the three use the count of steps only."""
    shape = inputs.fixed.shape
    return SwarmBelief(
        state=torch.cat((inputs.prior, inputs.prior), -1),
        variance=inputs.variance,
        joint=inputs.joint,
        ins_bias=ins_bias.initial(inputs.prior, None),
        joint_bias=joint_bias.initial(inputs.prior, inputs.delays, None, False),
        transitions=inputs.transitions.unsqueeze(1).expand(-1, shape[1], -1, -1),
        link_memory=inputs.variance.new_zeros(*shape, 0),
        localizable=inputs.fixed,
        step=torch.full(shape, step),
        error_sums=inputs.error_model.sums.unsqueeze(1).expand(-1, shape[1], -1, -1),
        window=window.empty(inputs.prior, inputs.joint, 0),
        delays=inputs.delays,
        considered=inputs.prior.unsqueeze(-1)[..., :0],
        batch_size=shape,
    )


def minimum(inputs: StepInput, weight: Tensor, precision: Tensor) -> np.ndarray:
    """Where scipy finds the least stress of the first world, from where dead reckoning is."""
    free = ~inputs.fixed[0]

    def cost(flat: np.ndarray) -> tuple[float, np.ndarray]:
        moved = torch.from_numpy(flat).view(-1, 3).requires_grad_(True)
        y = inputs.prior[:1].clone()
        y = y.index_put((torch.zeros(int(free.sum()), dtype=torch.int64), free.nonzero()[:, 0]),
                        moved)  # fmt: skip
        value = stress(
            y, inputs.links.distance[:1], weight[:1], inputs.prior[:1], precision[:1]
        ).sum()
        value.backward()
        assert moved.grad is not None
        return float(value.detach()), moved.grad.numpy().ravel()

    start = inputs.prior[0, free].numpy().ravel()
    best = minimize(cost, start, jac=True, method="BFGS", options={"gtol": 1e-9, "maxiter": 5000})
    return best.x.reshape(-1, 3)


# ---------------------------------------------------------------- the least stress


@pytest.mark.parametrize("prior_weight", [0.0, 1.0])
def test_dwmds_ends_where_scipy_finds_the_least_stress(prior_weight: float) -> None:
    inputs = team(1)
    agent = f"dwmds:bandwidth=1:prior_weight={prior_weight}:iterations=4000:first=4000"
    found = method(agent).solve(belief(inputs), inputs)
    weight = loess(inputs.links.distance, inputs.links.mask, 1.0) / STD**2
    precision = torch.where(inputs.fixed, 0.0, prior_weight / inputs.variance)
    best = minimum(inputs, weight, precision)
    np.testing.assert_allclose(found.position[0, ~inputs.fixed[0]], best, atol=1e-2)


@pytest.mark.parametrize("step", [0, 1])
def test_vmds_ends_where_scipy_finds_the_least_stress(step: int) -> None:
    inputs = team(2)
    agent = "vmds:velocity_weight=0.02:confidence=none:iterations=2000:first=2000"
    found = method(agent).solve(belief(inputs, step), inputs)
    weight = inputs.links.mask.double() / STD**2
    precision = torch.where(inputs.fixed, 0.0, 0.02 if step else 1 / inputs.variance)
    best = minimum(inputs, weight, precision)
    np.testing.assert_allclose(found.position[0, ~inputs.fixed[0]], best, atol=1e-2)


def test_fcmds_ends_where_scipy_finds_the_least_stress() -> None:
    inputs = team(3)
    found = method("fcmds:iterations=4000:first=4000").solve(belief(inputs), inputs)
    best = minimum(inputs, inputs.links.mask.double() / STD**2, torch.zeros_like(inputs.variance))
    np.testing.assert_allclose(found.position[0, ~inputs.fixed[0]], best, atol=1e-2)


def test_the_velocity_term_is_that_of_dead_reckoning() -> None:
    """λ_s ‖(p(t) − p(t−1))/Δt − v‖² = λ_s/Δt² ‖p(t) − (p(t−1) + v Δt)‖²: half the
    step in time, four times the weight in space."""
    inputs = team(4)
    slow = method("vmds:velocity_weight=0.04")
    fast = make("vmds:velocity_weight=0.01", make_scenario("swarm-v0", dt=0.5))
    assert isinstance(fast, SwarmFilter)
    one, other = (x.solve(belief(inputs), inputs).position for x in (slow, fast))
    assert torch.allclose(one, other, atol=1e-9)


@given(st.integers(0, 1000), st.floats(300.0, 1800.0), st.floats(0.0, 1e-2))
@settings(max_examples=15, deadline=None)
def test_sweeps_never_raise_the_stress(seed: int, reach: float, precision: float) -> None:
    inputs = team(seed, reach=reach)
    weight = loess(inputs.links.distance, inputs.links.mask, 1.0) / STD**2
    lam = torch.full_like(inputs.variance, precision).masked_fill(inputs.fixed, 0.0)
    parts = (inputs.links.distance, weight, inputs.prior, lam)
    y = inputs.prior + 100.0 * ~inputs.fixed.unsqueeze(-1)
    before = stress(y, *parts)
    for _ in range(20):
        y = jacobi_step(y, *parts, inputs.fixed)
        after = stress(y, *parts)
        assert (after <= before * (1 + 1e-12)).all()
        before = after
    assert torch.equal(y[inputs.fixed], inputs.prior[inputs.fixed])


@given(st.integers(0, 1000), st.floats(300.0, 1800.0), st.booleans())
@settings(max_examples=15, deadline=None)
def test_completing_never_raises_the_stress_of_what_was_measured(
    seed: int, reach: float, anchored: bool
) -> None:
    inputs = team(seed, reach=reach)
    fixed = inputs.fixed if anchored else torch.zeros_like(inputs.fixed)
    weight, nothing = inputs.links.mask.double(), torch.zeros_like(inputs.variance)
    component = connected(inputs.links.mask)
    y = inputs.prior + 100.0 * torch.sin(inputs.prior)
    before = stress(y, inputs.links.distance, weight, y, nothing)
    for _ in range(20):
        y = completed_step(y, inputs.links.distance, inputs.links.mask, component, fixed)
        after = stress(y, inputs.links.distance, weight, y, nothing)
        assert (after <= before * (1 + 1e-12)).all()
        before = after


def test_the_sweeps_diagonal_is_no_less_than_the_laplacian() -> None:
    inputs = team(5)
    weight = inputs.links.mask.double()
    factor = majorizer(weight, torch.zeros_like(inputs.variance), inputs.fixed)
    laplacian = factor @ factor.mT
    bound = jacobi_diagonal(weight, inputs.fixed).masked_fill(inputs.fixed, 1.0)
    assert (torch.linalg.eigvalsh(torch.diag_embed(bound) - laplacian) > -1e-9).all()


def test_without_anchors_and_with_all_distances_fcmds_is_scikit_learns() -> None:
    """Its SMACOF minimizes the same stress of a fully connected network."""
    manifold = pytest.importorskip("sklearn.manifold")
    inputs = team(6, worlds=1, reach=2000.0)
    distance = inputs.links.distance
    start = classical_scaling(distance, 3)
    nobody, all_of_them = torch.zeros_like(inputs.fixed), connected(inputs.links.mask)
    y = start
    for _ in range(2000):
        y = completed_step(y, distance, inputs.links.mask, all_of_them, nobody)
    _, best = manifold.smacof(
        distance[0].numpy(), n_components=3, init=start[0].numpy(), n_init=1, max_iter=3000,
        eps=1e-12, normalized_stress=False,
    )  # fmt: skip
    nothing = torch.zeros_like(inputs.variance)
    found = stress(y, distance, inputs.links.mask.double(), y, nothing)
    assert float(found) == pytest.approx(best, rel=1e-5)


def test_connected_parts_are_scipys() -> None:
    inputs = team(7, n=30, reach=250.0)
    found = connected(inputs.links.mask)
    for one, mask in zip(found, inputs.links.mask, strict=True):
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


# ---------------------------------------------------------------- variances


def test_information_of_anchors_is_fishers() -> None:
    """A UAV whose neighbours are all fixed: exactly."""
    inputs = team(8, worlds=1, n=6, reach=2000.0)
    weight, variance = inputs.links.mask.double() / STD**2, torch.zeros_like(inputs.variance)
    exact = lengths(inputs.prior) * inputs.links.mask
    found = anchor_information(inputs.prior, exact, weight, inputs.fixed, variance, STD)
    expected = fisher(inputs.prior, weight)[0, 5, :, 5]
    assert torch.allclose(found[0, 5], expected, rtol=1e-8)
    sure = position_variance(
        found, torch.full_like(variance, 1e-9), torch.ones_like(variance), inputs.fixed
    )
    expected_variance = torch.linalg.inv(expected).diagonal().mean()
    assert float(sure[0, 5]) == pytest.approx(float(expected_variance), rel=1e-4)


def test_larger_residuals_have_less_information() -> None:
    inputs = team(9)
    weight = inputs.links.mask.double()
    parts = (weight, inputs.fixed, inputs.variance, STD)
    exact = lengths(inputs.prior)
    good, bad = (
        anchor_information(inputs.prior, d * inputs.links.mask, *parts)
        for d in (exact, exact + 40.0)
    )
    assert (torch.linalg.eigvalsh(good - bad)[~inputs.fixed] > -1e-12).all()
    assert (good - bad)[~inputs.fixed].flatten(1).norm(dim=-1).min() > 0


def test_without_anchors_ranges_have_no_information() -> None:
    inputs = team(10)
    nobody = torch.zeros_like(inputs.fixed)
    weight = inputs.links.mask.double() / STD**2
    found = anchor_information(
        inputs.prior, inputs.links.distance, weight, nobody, inputs.variance, STD
    )
    variance = position_variance(found, torch.ones_like(inputs.variance), inputs.variance, nobody)
    assert torch.allclose(variance, inputs.variance)


def test_the_spread_of_a_weighted_mean() -> None:
    """By simulation: a prior with error N(0, P), ranges with information J, weights λ and J."""
    generator = torch.Generator().manual_seed(0)
    j, lam, p = 0.04, 0.01, 50.0
    start, ranged = torch.randn(2, 200_000, generator=generator, dtype=torch.float64)
    off = (lam * p**0.5 * start + j * ranged / j**0.5) / (lam + j)
    one = torch.ones(1, 1, dtype=torch.float64)
    found = position_variance(j * torch.eye(3).double()[None, None], lam * one, p * one, one < 0)
    assert float(found) == pytest.approx(float(off.square().mean()), rel=0.02)


# ---------------------------------------------------------------- whole steps


def permuted(inputs: StepInput, order: Tensor) -> StepInput:
    return replace(
        inputs,
        prior=inputs.prior[:, order],
        variance=inputs.variance[:, order],
        predicted_variance=inputs.predicted_variance[:, order],
        pair_variance=inputs.pair_variance[:, order][:, :, order],
        fixed=inputs.fixed[:, order],
        links=Links(
            inputs.links.distance[:, order][:, :, order], inputs.links.mask[:, order][:, :, order]
        ),
    )


@pytest.mark.parametrize("agent", [*METHODS, "fcmds:start=paths", "dwmds:reach=600"])
def test_they_are_equivariant_to_permutations(agent: str) -> None:
    inputs = team(11)
    order = torch.randperm(14, generator=torch.Generator().manual_seed(1))
    found, again = (method(agent).solve(belief(x), x) for x in (inputs, permuted(inputs, order)))
    assert torch.allclose(found.position[:, order], again.position, atol=1e-6)
    assert torch.allclose(found.variance[:, order], again.variance, rtol=1e-6)


def test_reach_drops_neighbours_that_are_far_by_dead_reckoning() -> None:
    inputs = team(12)
    near = lengths(inputs.prior) <= 500.0
    fewer = replace(inputs, links=Links(inputs.links.distance * near, inputs.links.mask & near))
    found = method("dwmds:reach=500:bandwidth=inf").solve(belief(inputs), inputs)
    expected = method("dwmds:bandwidth=inf").solve(belief(inputs), fewer)
    assert torch.equal(found.position, expected.position)
    everybody = method("dwmds:bandwidth=inf").solve(belief(inputs), inputs)
    assert not torch.equal(found.position, everybody.position)


@pytest.mark.parametrize("agent", [*METHODS, "fcmds:start=paths"])
def test_a_prior_that_is_not_finite_is_replaced_by_ranges(agent: str) -> None:
    inputs = team(13, reach=2000.0)
    place = inputs.prior.clone()
    place[0, 9] = torch.nan
    off = place.clone()
    localizer, lost = method(agent), replace(inputs, prior=place)
    for _ in range(40):
        found = localizer.solve(belief(lost, 0), lost)
        between = found.variance.unsqueeze(-1) + found.variance.unsqueeze(-2)
        lost = replace(lost, prior=found.position, variance=found.variance, pair_variance=between)
    usual = localizer.solve(belief(inputs, 0), inputs)
    for _ in range(39):
        usual = localizer.solve(
            belief(inputs, 0),
            replace(
                inputs,
                prior=usual.position,
                variance=usual.variance,
                pair_variance=usual.variance.unsqueeze(-1) + usual.variance.unsqueeze(-2),
            ),
        )
    assert found.position.isfinite().all()
    assert found.variance.isfinite().all()
    assert torch.allclose(found.position[1], usual.position[1], atol=1e-9)
    assert (found.position[0, 9] - usual.position[0, 9]).norm() < 60.0
    assert off[0, 9].isnan().all()  # not written to


def test_a_uav_without_prior_and_neighbours_starts_at_the_mean() -> None:
    inputs = team(14, worlds=1)
    place, mask = inputs.prior.clone(), inputs.links.mask.clone()
    place[0, 9] = torch.nan
    mask[0, 9] = mask[0, :, 9] = False
    found = with_finite_prior(
        replace(inputs, prior=place, links=Links(inputs.links.distance, mask))
    )
    others = torch.arange(14) != 9
    assert torch.allclose(found.prior[0, 9], place[0, others].mean(0))
    assert found.variance[0, 9] > 1e9
    assert torch.equal(found.variance[0, others], inputs.variance[0, others])


def episode(agent: str, steps: int = 6, **overrides: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Errors, positions and covariances of one world, step by step."""
    scenario = make_scenario("swarm-v0", **SMALL | overrides)
    localizer, world = make(agent, scenario), World(scenario, 1)
    observation = world.reset(torch.tensor([0]))
    inputs, found = localizer.reset(observation), []
    for _ in range(steps):
        inputs, estimate = localizer.step(inputs, observation)
        error = (estimate.position - world.truth.position).norm(dim=-1)
        found.append((error, estimate.position, estimate.covariance))
        world.advance(estimate.action())
        observation = world.observation()
    error, position, covariance = (torch.stack(x) for x in zip(*found, strict=True))
    return error, position, covariance


@pytest.mark.parametrize("agent", METHODS)
def test_they_localize(agent: str) -> None:
    error, _, _ = episode(agent, 15, nlos=0.0)
    reckoned, _, _ = episode("dead_reckoning", 15, nlos=0.0)
    anchors = 9
    assert error[5:, :, anchors:].square().mean().sqrt() < 12.0
    assert reckoned[5:, :, anchors:].square().mean().sqrt() > 60.0


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
    _, position, covariance = episode(agent, 4, **overrides)
    assert position.isfinite().all()
    assert (torch.linalg.eigvalsh(covariance) > 0).all()


@pytest.mark.parametrize("agent", METHODS)
def test_without_links_they_dead_reckon_with_its_covariance(agent: str) -> None:
    _, alone, covariance = episode(agent, comm_radius=1.0)
    _, reckoned, expected = episode("dead_reckoning", comm_radius=1.0)
    anchors = 9
    assert torch.allclose(alone[..., anchors:, :], reckoned[..., anchors:, :], atol=1e-3)
    assert torch.allclose(covariance[:, :, anchors:], expected[:, :, anchors:], rtol=1e-4)


@pytest.mark.parametrize("agent", METHODS)
def test_without_anchors_variances_grow(agent: str) -> None:
    _, _, covariance = episode(agent, anchor_share=0.0)
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    assert (variance.diff(dim=0)[1:] > 0).all()
    assert (variance[-1] >= 2500.0).all()


@pytest.mark.parametrize(
    ("agent", "words"),
    [
        ("dwmds:bandwidth=0", "bandwidth='0' is not allowed"),
        ("dwmds:prior_weight=-1", "prior_weight='-1' is not allowed"),
        ("dwmds:prior_weight=inf", "prior_weight='inf' is not allowed"),
        ("dwmds:reach=0", "reach='0' is not allowed"),
        ("dwmds:iterations=0", "iterations='0' is not allowed"),
        ("vmds:velocity_weight=0", "velocity_weight='0' is not allowed"),
        ("vmds:iterations=31", "iterations=31, first=30 is not allowed"),
        ("fcmds:iterations=0", "iterations='0' is not allowed"),
        ("fcmds:start=here", "start='here' is not allowed"),
    ],
)
def test_wrong_options(agent: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make(agent, make_scenario("swarm-v0"))


def test_observations_of_nan_give_finite_estimates() -> None:
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
