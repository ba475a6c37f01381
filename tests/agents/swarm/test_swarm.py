"""Scaling, majorization, calibration and Gauss–Newton on whole teams, against others' results."""

import itertools

import numpy as np
import pytest
import torch
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.linalg import orthogonal_procrustes
from scipy.optimize import least_squares, minimize
from scipy.sparse.csgraph import floyd_warshall
from scipy.stats import norm
from torch import Tensor

from agents import make
from agents.swarm import calibration, ins_bias, joint, persistence, weights
from agents.swarm.gauss_newton import fisher, gauss_newton
from agents.swarm.links import lengths, links_of
from agents.swarm.majorization import descent, guttman_step, majorizer, stress
from agents.swarm.scaling import classical_scaling, procrustes, shortest_paths
from coloc_env.observation import Observation
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import Ins

STD = 10.0


def team(seed: int, n: int = 12, worlds: int = 2, reach: float = 700.0) -> dict[str, Tensor]:
    """Random places, noisy ranges within reach, a prior, and four who are fixed."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    place = 1000 * torch.rand(worlds, n, 3, generator=generator, dtype=torch.float64)
    true = lengths(place)
    mask = true < reach
    mask.diagonal(dim1=-2, dim2=-1).fill_(False)
    noise = torch.triu(normal(worlds, n, n), 1)
    distance = (true + STD * (noise + noise.mT)) * mask
    fixed = torch.zeros(worlds, n, dtype=torch.bool)
    fixed[:, :4] = True
    prior = torch.where(fixed.unsqueeze(-1), place, place + 30 * normal(worlds, n, 3))
    trust = torch.where(fixed, 0.0, torch.full((worlds, n), 1 / 900.0, dtype=torch.float64))
    return {
        "place": place,
        "distance": distance,
        "mask": mask,
        "weight": mask.double() / STD**2,
        "fixed": fixed,
        "prior": prior,
        "trust": trust,
    }


# ---------------------------------------------------------------- links and scaling


def test_either_ends_report_makes_a_link() -> None:
    ranges = torch.tensor([[[0.0, 5.0, 7.0], [5.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    links = links_of(Observation({"ranges": ranges, "range_mask": (ranges > 0).float()}))
    expected = [[0.0, 5.0, 7.0], [5.0, 0.0, 0.0], [7.0, 0.0, 0.0]]
    assert links.distance[0].tolist() == expected
    assert torch.equal(links.mask, links.distance > 0)


def test_links_from_neighbour_slots() -> None:
    ranges = torch.tensor([[[7.0, 0.0], [0.0, 0.0], [7.0, 0.0]]])
    slots = torch.tensor([[[2.0, 0.0], [0.0, 0.0], [0.0, 0.0]]])
    leaves = {"ranges": ranges, "range_mask": (ranges > 0).float(), "neighbours": slots}
    links = links_of(Observation(leaves))
    assert links.distance[0].tolist() == [[0.0, 0.0, 7.0], [0.0, 0.0, 0.0], [7.0, 0.0, 0.0]]
    assert links.mask.sum() == 2


@given(st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_classical_scaling_restores_exact_distances(seed: int) -> None:
    place = team(seed)["place"]
    true = lengths(place)
    assert torch.allclose(lengths(classical_scaling(true, 3)), true, atol=1e-6)


def test_classical_scaling_is_torgersons_eigendecomposition() -> None:
    paths = shortest_paths(team(1)["distance"], team(1)["mask"])[0].numpy()
    centring = np.eye(12) - 1 / 12
    values, vectors = np.linalg.eigh(-0.5 * centring @ paths**2 @ centring)
    best = np.argsort(values)[::-1][:3]
    expected = vectors[:, best] * np.sqrt(values[best])
    found = classical_scaling(torch.from_numpy(paths)[None], 3)[0].numpy()
    np.testing.assert_allclose(np.abs(found), np.abs(expected), atol=1e-8)


def test_shortest_paths_are_scipys() -> None:
    world = team(2, reach=450.0)
    found = shortest_paths(world["distance"], world["mask"])
    for one, distance in zip(found, world["distance"], strict=True):
        np.testing.assert_allclose(one, floyd_warshall(distance.numpy(), directed=False))


@given(st.integers(0, 1000), st.floats(0.2, 5.0))
@settings(max_examples=10, deadline=None)
def test_alignment_undoes_any_similarity(seed: int, scale: float) -> None:
    place = team(seed)["place"]
    generator = torch.Generator().manual_seed(seed)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
    weight = torch.zeros(2, 12, dtype=torch.float64)
    weight[:, :5] = 1.0
    assert torch.allclose(procrustes(scale * place @ turn + 7.0, place, weight), place, atol=1e-6)


def test_alignment_turns_as_scipy_does() -> None:
    world = team(3)
    a, b = (x[0] - x[0].mean(0) for x in (world["prior"], world["place"]))
    turn, scale = orthogonal_procrustes(a.numpy(), b.numpy())
    expected = scale / (a.numpy() ** 2).sum() * a.numpy() @ turn
    found = procrustes(a[None], b[None], torch.ones(1, 12, dtype=torch.float64))[0]
    np.testing.assert_allclose(found, expected, atol=1e-9)


# ---------------------------------------------------------------- majorization


def parts(world: dict[str, Tensor]) -> tuple[Tensor, ...]:
    return tuple(world[name] for name in ("distance", "weight", "prior", "trust"))


@given(st.integers(0, 1000), st.floats(300.0, 1800.0))
@settings(max_examples=15, deadline=None)
def test_majorization_never_raises_the_stress(seed: int, reach: float) -> None:
    world = team(seed, reach=reach)
    y, fixed = world["prior"] + 100.0 * ~world["fixed"].unsqueeze(-1), world["fixed"]
    factor = majorizer(world["weight"], world["trust"], fixed)
    before = stress(y, *parts(world))
    for _ in range(20):
        y = guttman_step(y, *parts(world), fixed, factor)
        after = stress(y, *parts(world))
        assert (after <= before * (1 + 1e-12)).all()
        before = after
    assert torch.equal(y[fixed], world["place"][fixed])


def test_descent_is_half_the_stresss_gradient() -> None:
    world = team(4)
    y = world["prior"].clone().requires_grad_(True)
    stress(y, *parts(world)).sum().backward()
    found = descent(y.detach(), *parts(world))
    assert y.grad is not None
    assert torch.allclose(found, -0.5 * y.grad, rtol=1e-9, atol=1e-9)


def test_majorization_ends_in_the_minimum_that_scipy_finds() -> None:
    world = {name: x[:1] for name, x in team(5).items()}
    y, fixed = world["prior"], world["fixed"]
    factor = majorizer(world["weight"], world["trust"], fixed)
    for _ in range(3000):
        y = guttman_step(y, *parts(world), fixed, factor)
    free = ~fixed[0]

    def cost(flat: np.ndarray) -> float:
        trial = world["place"].clone()
        trial[0, free] = torch.from_numpy(flat).view(-1, 3)
        return float(stress(trial, *parts(world)))

    best = minimize(cost, world["prior"][0, free].numpy().ravel(), options={"gtol": 1e-8})
    assert float(stress(y, *parts(world))) == pytest.approx(best.fun, rel=1e-6)
    np.testing.assert_allclose(y[0, free].ravel(), best.x, atol=1e-2)


def test_without_links_a_uav_stays_at_its_prior() -> None:
    world = team(6)
    world["weight"][:, 7] = world["weight"][:, :, 7] = 0.0
    factor = majorizer(world["weight"], world["trust"], world["fixed"])
    y = world["prior"] + 5.0
    for _ in range(3):
        y = guttman_step(y, *parts(world), world["fixed"], factor)
    assert torch.allclose(y[:, 7], world["prior"][:, 7])


# ---------------------------------------------------------------- calibration


@pytest.mark.parametrize(("share", "bias", "spread"), [(0.15, 25.0, 10.0), (0.5, 0.0, 50.0)])
def test_calibration_finds_the_mixture(share: float, bias: float, spread: float) -> None:
    generator = torch.Generator().manual_seed(0)
    model = calibration.prior_model(1, STD, torch.device("cpu"))
    for _ in range(60):
        outlier = torch.rand(1, 400, generator=generator) < share
        normal = torch.randn(1, 400, generator=generator, dtype=torch.float64)
        error = torch.where(outlier, bias + spread * normal, STD * normal)
        model = calibration.em_update(model, error, torch.ones_like(error), 0 * error, STD)
    mean, variance = model.component(STD)
    assert float(model.share[0, 1]) == pytest.approx(share, abs=0.04)
    assert float(mean[0, 1]) == pytest.approx(bias, abs=3.0)
    assert variance[0].sqrt().tolist() == pytest.approx([STD, spread], rel=0.15)


def test_links_without_ranges_do_not_calibrate() -> None:
    model = calibration.prior_model(1, STD, torch.device("cpu"))
    wild = torch.full((1, 50), 500.0, dtype=torch.float64)
    after = calibration.em_update(model, wild, torch.zeros_like(wild), torch.zeros_like(wild), STD)
    assert torch.allclose(after.share, model.share)


def test_calibration_separates_the_variance_of_the_ends() -> None:
    generator = torch.Generator().manual_seed(1)
    variance_ = 100.0
    model = calibration.prior_model(1, STD, torch.device("cpu"))
    for _ in range(60):
        outlier = torch.rand(1, 2000, generator=generator) < 0.3
        own = torch.randn(2, 1, 2000, generator=generator, dtype=torch.float64)
        error = torch.where(outlier, 60.0, 0.0) + STD * own[0] + variance_**0.5 * own[1]
        added = torch.full_like(error, variance_)
        model = calibration.em_update(model, error, torch.ones_like(error), added, STD)
    mean, variance = model.component(STD)
    assert float(model.share[0, 1]) == pytest.approx(0.3, abs=0.05)
    assert float(mean[0, 1]) == pytest.approx(60.0, abs=4.0)
    assert float(variance[0, 0]) == pytest.approx(STD**2, rel=0.5)


@pytest.mark.parametrize("share", [0.0, 0.15, 0.5, 0.83])
def test_information_is_scipys_integral(share: float) -> None:
    mean, variance = 30.0, 15.0**2
    count = torch.tensor((50.0, 50.0), dtype=torch.float64)
    first, second = (
        count * torch.tensor((0.0, mean)),
        count * torch.tensor((STD**2, variance + mean**2)),
    )
    model = calibration.ErrorModel(
        sums=torch.stack((count, first.double(), second.double()), -1)[None], batch_size=(1,)
    )

    def density(e: float) -> float:
        return (1 - share) * norm.pdf(e, 0, STD) + share * norm.pdf(e, mean, variance**0.5)

    def slope(e: float) -> float:
        other = share * norm.pdf(e, mean, variance**0.5) * (mean - e) / variance
        return (1 - share) * norm.pdf(e, 0, STD) * -e / STD**2 + other

    expected, _ = quad(lambda e: slope(e) ** 2 / density(e), -60, 120, limit=200)
    prior = torch.tensor([[share]], dtype=torch.float64)
    found = calibration.fisher_information(model, prior, STD)
    assert float(found) == pytest.approx(expected, rel=0.01)


# ---------------------------------------------------------------- persistent NLOS


def chain_of_states(rho: float, share: float, steps: int, links: int) -> Tensor:
    """States [steps, links] of a chain that is drawn again with probability 1 − ρ."""
    generator = torch.Generator().manual_seed(3)
    state = torch.rand(links, generator=generator) < share
    states = [state]
    for _ in range(steps - 1):
        kept, drawn = torch.rand(2, links, generator=generator)
        state = torch.where(kept < rho, state, drawn < share)
        states.append(state)
    return torch.stack(states)


def test_links_states_are_those_of_the_brute_force_forward_algorithm() -> None:
    rho, share, steps = 0.8, 0.3, 8
    evidence = 2 * torch.randn(steps, generator=torch.Generator().manual_seed(0)).double()
    found = torch.tensor([[share]], dtype=torch.float64)
    one = torch.tensor([rho], dtype=torch.float64)
    for each in evidence:
        found = persistence.predict(found, one, one.new_tensor([share]))
        found = torch.sigmoid(torch.logit(found) + each)
    weights_of_paths, obstructed = 0.0, 0.0
    for path in itertools.product((0, 1), repeat=steps):
        p = share if path[0] else 1 - share
        for before, now in itertools.pairwise(path):
            p *= rho * (before == now) + (1 - rho) * (share if now else 1 - share)
        p *= float(np.exp((np.array(path) * evidence.numpy()).sum()))
        weights_of_paths += p
        obstructed += p * path[-1]
    assert float(found) == pytest.approx(obstructed / weights_of_paths, abs=1e-9)


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_persistence_is_learned(rho: float) -> None:
    share, links = 0.4, 400
    states = chain_of_states(rho, share, 60, links)
    noise = STD * torch.randn(states.shape, generator=torch.Generator().manual_seed(4))
    error = torch.where(states, 25.0, 0.0) + noise
    evidence = ((error.square() - (error - 25.0).square()) / (2 * STD**2)).double()
    shares = torch.tensor([share], dtype=torch.float64)
    counts = persistence.prior_counts(shares)
    before = torch.full((1, links), share, dtype=torch.float64)
    ones = torch.ones_like(before)
    for each in evidence:
        counts = persistence.update(counts, before, each[None], ones, shares)
        prior = persistence.predict(before, persistence.persistence(counts), shares)
        before = torch.sigmoid(torch.logit(prior) + each)
    assert float(persistence.persistence(counts)) == pytest.approx(rho, abs=0.06)


# ---------------------------------------------------------------- INS bias


def test_the_bias_is_filterpys() -> None:
    ins, dt, other = Ins(std=0.5, bias=0.8, bias_time=30.0), 2.0, 9.0
    kept = float(np.exp(-dt / ins.bias_time))
    reference = KalmanFilter(dim_x=2, dim_z=1)  # position and bias
    reference.P = np.diag((100.0, ins.bias**2))
    reference.F = np.array(((1.0, -dt * kept), (0.0, kept)))
    grown = ins.bias**2 * (1 - kept**2)
    reference.Q = grown * np.outer((-dt, 1.0), (-dt, 1.0)) + np.diag((dt**2 * ins.std**2, 0.0))
    reference.H, reference.R = np.array(((1.0, 0.0),)), np.array(((other,),))
    reference.B = np.array(((dt,), (0.0,)))
    zero = torch.zeros(1, 1, dtype=torch.float64)
    state = ins_bias.initial(zero.unsqueeze(-1), ins)
    place, variance = zero.unsqueeze(-1), zero + 100.0
    time = torch.full_like(zero, dt)
    for speed, seen in zip((1.0, -2.0, 0.5, 3.0), (4.0, 1.0, 2.5, 9.0), strict=True):
        reference.predict(u=np.array(((speed,),)))
        reference.update(np.array(((seen,),)))
        state = ins_bias.decay(state, time, ins)
        before = place + (speed - state.bias) * dt
        state, factor, new = ins_bias.predict(state, variance, time, ins)
        was = factor.square() * variance + new
        variance = 1 / (1 / was + 1 / other)
        place = before + (variance / other).unsqueeze(-1) * (seen - before)
        state = ins_bias.update(state, place - before, was, variance)
    found = (float(place), float(state.bias))
    np.testing.assert_allclose(found, reference.x.ravel(), rtol=1e-9)
    moments = ((float(variance), float(state.cross)), (float(state.cross), float(state.variance)))
    np.testing.assert_allclose(moments, reference.P, rtol=1e-9)


# ---------------------------------------------------------------- the joint covariance


@pytest.mark.parametrize("e", [1, 3])
def test_joint_covariance_is_numpys(e: int) -> None:
    world = team(9)
    y, fixed, variance = world["place"], world["fixed"], torch.full((2, 12), 9.0).double()
    variance[fixed] = 0.25
    k = 12 * e
    root = torch.randn(2, k, k, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    before = (root @ root.mT + k * torch.eye(k)).unflatten(1, (12, e))
    factor, noise = (
        torch.linspace(0.8, 1.0, 24).double().view(2, 12),
        4 * torch.ones(2, 12).double(),
    )
    now = joint.predict(before, factor, noise, fixed, 0.25)
    index = joint.free_indices(fixed)
    trust = joint.precision(joint.submatrix(now, index), fixed[:, index])
    every = torch.arange(12)

    def information_on(index: Tensor) -> Tensor:
        if e == 1:
            return joint.laplacian(world["weight"] / 3, index)
        return joint.submatrix(fisher(y, world["weight"]).flatten(3), index).flatten(1, 2)

    links = information_on(index)
    found = joint.embed(
        joint.posterior(links + trust, fixed[:, index], variance[:, index]), index, variance
    )
    each = factor.repeat_interleave(e, -1)[0].numpy()
    whole = each[:, None] * before.flatten(1, 2)[0].numpy() * each + 4 * np.eye(k)
    free = slice(4 * e, None)
    both = information_on(every)[0].numpy()[free, free]
    expected = np.linalg.inv(np.linalg.inv(whole[free, free]) + both)
    result = found.flatten(1, 2)[0].numpy()
    np.testing.assert_allclose(result[free, free], expected, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(result[: 4 * e, : 4 * e], 0.25 * np.eye(4 * e))
    apart = joint.pair_variance(found)[0, 5, 9]
    blocks = result.reshape(12, e, 12, e)
    difference = blocks[5, :, 5] + blocks[9, :, 9] - blocks[5, :, 9] - blocks[9, :, 5]
    assert float(apart) == pytest.approx(np.trace(difference) / e)


def test_a_link_with_an_outliers_residual_is_shifted_back_and_counts_less() -> None:
    model = calibration.ErrorModel(
        sums=torch.tensor([[[85.0, 0.0, 8500.0], [15.0, 375.0, 15 * (625 + 100.0)]]]).double(),
        batch_size=(1,),
    )
    residual = torch.tensor([[[0.0, 25.0], [12.5, 60.0]]], dtype=torch.float64)
    weight, shift = calibration.weights_and_shifts(model, residual, torch.zeros_like(residual), STD)
    assert 0.0 < float(shift[0, 0, 0]) < 3.0 < 20.0 < float(shift[0, 0, 1]) < 25.0
    assert torch.allclose(weight, torch.full_like(weight, 1 / STD**2))  # both as wide
    assert (shift.diff(dim=-1) > 0).all()


def test_huber_weights_are_scipys() -> None:
    residual = torch.tensor([[[1.0, 13.45], [-26.9, 0.0]]], dtype=torch.float64)
    mask, zero = torch.ones(1, 2, 2, dtype=torch.bool), torch.zeros(1, 2, 2).double()
    weight, _ = weights.huber(residual, mask, zero, STD)
    assert (weight * STD**2)[0].tolist() == [[1.0, 1.0], [pytest.approx(0.5), 1.0]]


def test_the_papers_confidence_is_equation_17() -> None:
    """clip(1 − 0.5 s − 0.3 ρ, 0.1, 1), s for residuals beyond three standard deviations."""
    residual = torch.tensor([[[0.0, 31.0], [-31.0, 31.0]]], dtype=torch.float64)
    packet_loss = torch.tensor([[[0.0, 0.0], [0.5, 1.0]]], dtype=torch.float64)
    found = weights.paper_confidence(residual, packet_loss, torch.zeros_like(residual), STD)
    np.testing.assert_allclose(found[0], [[1.0, 0.5], [0.85, 0.2]])
    wide = weights.paper_confidence(residual, packet_loss, 10.0 + 0 * residual, STD)
    np.testing.assert_allclose(wide[0], [[1.0, 1.0], [0.85, 0.7]])


# ---------------------------------------------------------------- Gauss–Newton


def test_gauss_newton_is_scipys_least_squares() -> None:
    world = {name: x[:1] for name, x in team(7).items()}
    fixed, free = world["fixed"], ~world["fixed"][0]
    precision = torch.diag_embed(world["trust"].repeat_interleave(3, -1))
    found, _, information = gauss_newton(
        world["prior"],
        world["distance"],
        lambda residual: weights.uniform(residual, world["mask"], STD),
        fixed,
        world["prior"],
        precision,
        20,
    )
    pairs = torch.triu(world["mask"][0], 1).nonzero().numpy()

    def residuals(flat: np.ndarray) -> np.ndarray:
        trial = world["place"][0].numpy().copy()
        trial[free] = flat.reshape(-1, 3)
        apart = np.linalg.norm(trial[pairs[:, 0]] - trial[pairs[:, 1]], axis=1)
        links = (world["distance"][0].numpy()[tuple(pairs.T)] - apart) / STD
        prior = (trial[free] - world["prior"][0, free].numpy()) / 30.0
        return np.concatenate((links, prior.ravel()))

    best = least_squares(residuals, world["prior"][0, free].numpy().ravel(), xtol=1e-14)
    np.testing.assert_allclose(found[0, free].ravel(), best.x, atol=1e-4)
    kept = free.repeat_interleave(3)
    np.testing.assert_allclose(information[0][kept][:, kept], best.jac.T @ best.jac, rtol=1e-3,
                               atol=1e-5)  # fmt: skip


def test_fisher_information_is_that_of_automatic_differentiation() -> None:
    world = {name: x[:1] for name, x in team(8, n=6).items()}
    pairs = torch.triu(world["mask"][0], 1).nonzero().T

    def measured(flat: Tensor) -> Tensor:
        place = flat.view(6, 3)
        return (place[pairs[0]] - place[pairs[1]]).norm(dim=-1) / STD

    jacobian = torch.func.jacrev(measured)(world["place"].flatten())
    found = fisher(world["place"], world["weight"])[0].flatten(2).flatten(0, 1)
    assert torch.allclose(found, jacobian.mT @ jacobian, atol=1e-12)


@pytest.mark.parametrize("agent", ["map", "stdcl", "dwmds_st", "vmds"])
def test_ranges_without_noise_are_refused(agent: str) -> None:
    with pytest.raises(ValueError, match="no noise weigh too much: uwb_std=0"):
        make(agent, make_scenario("swarm-v0", n_uavs=5, uwb_std=0.0))
    make(agent, make_scenario("swarm-v0", n_uavs=5, uwb_std=0.0, believed_uwb_std=0.1))
