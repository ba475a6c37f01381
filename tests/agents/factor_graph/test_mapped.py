"""Smoothers with landmarks in their graphs: against GTSAM, scipy, and known maps."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from agents import make
from agents.factor_graph.bordered import Bordered, Shared, Solved, solve
from agents.factor_graph.condensed import Common, Tracks, tie
from agents.factor_graph.mapped import MappedFactorGraph
from agents.models.measurements import Block
from coloc_env.scenarios import make_scenario
from coloc_env.world import World
from tests.agents.factor_graph.test_dfgo import E, W, chain, normal, spd
from tests.agents.slam.test_slam import least, true_map, unknown

L = 3  # numbers that all states share


def bordered(seed: int, rank: int = E) -> Bordered:
    """A random chain with a border."""
    whole = spd(1, 1, W, E + L, seed=seed + 20)
    shared = Shared(
        spd(1, 1, L, seed=seed + 21), normal(1, 1, L, seed=seed + 22),
        normal(1, 1, E, L, seed=seed + 23),
    )  # fmt: skip
    states = replace(chain(seed, rank), precision=whole[..., :E, :E])
    vector = normal(1, 1, W, L, seed=seed + 24)
    return Bordered(states, shared, whole[..., :E, E:], whole[..., E:, E:], vector)


def joint(solved: Solved) -> Tensor:
    """Covariance of all states, then of what they share."""
    spread = torch.linalg.inv(solved.shared.precision)[0, 0]
    slopes = solved.slopes[0, 0].flatten(0, 1)
    states = solved.states.joint()[0, 0].transpose(1, 2).reshape(W * E, W * E)
    across = slopes @ spread
    upper = torch.cat((states + across @ slopes.mT, across), 1)
    return torch.cat((upper, torch.cat((across.mT, spread), 1)))


def gtsam_graph(b: Bordered, steps: range) -> Any:
    """The factors of some steps; what all states share has the key W."""
    gtsam = pytest.importorskip("gtsam")
    graph, unit, states = gtsam.GaussianFactorGraph(), gtsam.noiseModel.Unit.Create(E), b.chain

    def whitened(covariance: Tensor) -> np.ndarray:
        return np.linalg.inv(np.linalg.cholesky(covariance[0, 0].numpy()))

    if 0 in steps:
        root, slope = whitened(states.covariance), b.shared.slope[0, 0].numpy()
        mean = root @ states.mean[0, 0].numpy()
        graph.add(gtsam.JacobianFactor(0, root, W, -root @ slope, mean, unit))
        about = b.shared.precision[0, 0].numpy(), b.shared.vector[0, 0].numpy()
        graph.add(gtsam.HessianFactor(W, *about, 0.0))
    for k in steps:
        parts = (states.precision, b.border, states.vector, b.precision, b.vector)
        a, border, vector, about, eta = (part[0, 0, k].numpy() for part in parts)
        graph.add(gtsam.HessianFactor(k, W, a, border, vector, about, eta, 0.0))
        if k < W - 1:
            root = whitened(states.noise[:, :, k])
            f, d = states.transition[0, 0, k].numpy(), states.offset[0, 0, k].numpy()
            graph.add(gtsam.JacobianFactor(k, -root @ f, k + 1, root, root @ d, unit))
    return graph


@pytest.mark.parametrize("seed", [0, 30])
def test_a_chain_with_a_border_is_solved_as_gtsam_does(seed: int) -> None:
    """Means and all covariances, and the prior that marginalizing the oldest state leaves."""
    made = bordered(seed)
    graph, found = gtsam_graph(made, range(W)), solve(made)
    solution = graph.optimize()
    for k in range(W):
        np.testing.assert_allclose(found.states.mean[0, 0, k], solution.at(k), rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(found.shared.mean[0, 0], solution.at(W), rtol=1e-7)
    hessian, _ = graph.hessian()
    np.testing.assert_allclose(joint(found), np.linalg.inv(hessian), rtol=1e-6, atol=1e-8)

    first = gtsam_graph(made, range(1))  # of the oldest state, the second, and what is shared
    hessian, vector = first.hessian()
    spread = np.linalg.inv(hessian)[E:, E:]
    mean = (np.linalg.inv(hessian) @ vector)[E:]
    onward, slope = torch.linalg.inv(found.next.precision)[0, 0], found.next.slope[0, 0]
    np.testing.assert_allclose(onward, spread[E:, E:], rtol=1e-7)
    np.testing.assert_allclose(slope @ onward, spread[:E, E:], rtol=1e-6, atol=1e-9)
    given = found.states.next_covariance[0, 0] + slope @ onward @ slope.mT
    np.testing.assert_allclose(given, spread[:E, :E], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.states.next_mean[0, 0], mean[:E], rtol=1e-6)
    np.testing.assert_allclose(found.next.mean[0, 0], mean[E:], rtol=1e-6)


def test_noise_may_be_of_less_than_full_rank() -> None:
    """As that of an IMU is; in the limit of a little noise in all directions."""
    made = bordered(0, rank=2)
    little = replace(made.chain, noise=made.chain.noise + 1e-9 * torch.eye(E).double())
    found, near = solve(made), solve(replace(made, chain=little))
    torch.testing.assert_close(joint(found), joint(near), rtol=1e-5, atol=1e-6)


def test_ties_of_tracks_that_share_a_map() -> None:
    """Two windows that depend on one map, and linear measurements between them, as one linear
    system (NumPy) of both windows and the map."""
    d = 2
    own, theirs = solve(bordered(5)), solve(bordered(6))
    spread = spd(1, 1, L, seed=4)
    j, g = normal(1, 1, W, 1, 1, E, seed=7), normal(1, 1, W, 1, 1, d, seed=8)
    r, variance = normal(1, 1, W, 1, 1, seed=9), torch.full((1, 1, W, 1, 1), 0.3).double()
    mask = torch.tensor([True, True, False, True, True]).view(1, 1, W, 1)
    other = theirs.states.joint()[..., :d, :d].unsqueeze(2)
    slope = theirs.slopes[..., :d, :].unsqueeze(2)
    tracks = Tracks(torch.zeros(1, 1, 1, W, d), other, mask.mT, slope)
    block = Block(r, j, variance, mask, partner=g)
    linear = lambda delta: [replace(block, residual=r - (j @ delta[..., None, :, None])[..., 0])]  # noqa: E731
    common = Common(own.slopes, spread)
    found = tie(own.states.joint(), tracks, linear, "none", iterations=1, common=common)

    def wide(x: Tensor, size: int) -> np.ndarray:
        return x.reshape(W, W, size, size).transpose(1, 2).reshape(W * size, -1).numpy()

    ours, others = own.slopes[0, 0].reshape(W * E, L).numpy(), slope.reshape(W * d, L).numpy()
    both = np.concatenate((ours, others))
    prior = both @ spread[0, 0].numpy() @ both.T
    prior[: W * E, : W * E] += wide(own.states.joint(), E)
    prior[W * E :, W * E :] += wide(other, d)
    h = np.zeros((W, W * (E + d)))
    for k in range(W):
        h[k, k * E : (k + 1) * E] = j[0, 0, k, 0, 0]
        h[k, W * E + k * d : W * E + (k + 1) * d] = g[0, 0, k, 0, 0]
    keep = mask.flatten().numpy()
    h, z = h[keep], r.flatten().numpy()[keep]
    gain = prior @ h.T @ np.linalg.inv(h @ prior @ h.T + 0.3 * np.eye(len(z)))
    np.testing.assert_allclose(found.delta.flatten(), (gain @ z)[: W * E], rtol=1e-5, atol=1e-8)
    after = (prior - gain @ h @ prior)[(W - 1) * E : W * E, (W - 1) * E : W * E]
    np.testing.assert_allclose(found.covariance[0, 0], after, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("name", ["dfgo_central", "dfgo:exchange=none"])
def test_a_first_step_is_scipys_least_squares(name: str) -> None:
    """Poses and landmarks of one step, all residuals whitened and given to scipy at once."""
    scenario = unknown(n_uavs=2, landmarks=5, uwb=False, landmark_radius=40.0)
    seen = World(scenario).reset(3)
    localizer: Any = make(f"{name}:iterations=12:robust=none:window=2", scenario)
    assert isinstance(localizer, MappedFactorGraph)
    before = localizer.reset(seen)
    belief, estimate = localizer.step(before, seen)
    prior: Any = SimpleNamespace(state=before.track.prior, landmarks=before.landmarks)
    as_slam: Any = localizer
    for group in ([0, 1],) if localizer.centralized else ([0], [1]):
        mean, spread = least(as_slam, prior, seen, group)
        np.testing.assert_allclose(belief.landmarks[0, group[0]].flatten(), mean[-15:], atol=2e-4)
        for k, i in enumerate(group):
            own = slice(9 * k, 9 * k + 3)
            np.testing.assert_allclose(estimate.position[0, i], mean[own], atol=2e-4)
            np.testing.assert_allclose(estimate.covariance[0, i], spread[own, own], rtol=0.02)


@pytest.mark.parametrize("name", ["dfgo", "dfgo_central"])
def test_with_the_map_it_is_the_smoother_that_is_given_it(name: str) -> None:
    overrides: dict[str, Any] = {"anchors": 2, "n_uavs": 2, "prior_std": 0.3, "landmarks": 6}
    name = f"{name}:window=4"

    def errors(known: bool) -> Tensor:
        scenario = make_scenario("indoor-v0", landmarks_known=known, **overrides)
        world, localizer = World(scenario), make(name, scenario)
        seen = world.reset([5])
        belief: Any = localizer.reset(seen)
        if not known:
            places = true_map(world).unsqueeze(1).expand_as(belief.landmarks)
            belief = belief.replace(
                landmarks=places,
                before=places,
                precision=1e8 * torch.eye(18).double().expand_as(belief.precision),
                found=torch.ones_like(belief.found),
            )
        found = []
        for _ in range(8):
            belief, estimate = localizer.step(belief, seen)
            found.append(estimate.position - world.truth.position)
            world.advance(estimate.action())
            seen = world.observation()
        return torch.stack(found)

    torch.testing.assert_close(errors(True), errors(False), rtol=0, atol=5e-4)


def test_who_cannot_is_refused() -> None:
    with pytest.raises(ValueError, match="dfgo: each UAV needs a slot for every other to share"):
        make("dfgo", unknown(n_uavs=20))
    assert make("dfgo:exchange=all", unknown(n_uavs=20)).name == "dfgo"
    with pytest.raises(ValueError, match="the motion model has no attitude"):
        make("dfgo", unknown(imu=False))
