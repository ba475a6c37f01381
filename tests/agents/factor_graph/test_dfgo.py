"""The fixed-lag smoother: exact where the world is linear, consistent, nothing counted twice."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from agents import make
from agents.factor_graph.chain import Chain, smooth
from agents.factor_graph.condensed import Tracks, condensed, tie
from agents.models.measurements import Block
from coloc_env.motion import Arena, RandomVelocity
from coloc_env.network import Network
from coloc_env.scenario import ConstantVelocity, Prior, Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import PositionFix
from coloc_env.world import World

W, E = 5, 4


def spd(*shape: int, seed: int) -> Tensor:
    root = torch.randn(*shape, shape[-1], generator=torch.Generator().manual_seed(seed)).double()
    return root @ root.mT + 0.1 * torch.eye(shape[-1]).double()


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).double()


def chain(seed: int, rank: int = E) -> Chain:
    """A random chain, whose process noise has the rank given."""
    root = normal(1, 1, W - 1, E, rank, seed=seed)
    weak = normal(1, 1, W, E, 2, seed=seed + 1)
    return Chain(
        normal(1, 1, E, seed=seed + 2),
        spd(1, 1, E, seed=seed + 3),
        normal(1, 1, W - 1, E, E, seed=seed + 4),
        normal(1, 1, W - 1, E, seed=seed + 5),
        root @ root.mT,
        weak @ weak.mT,
        normal(1, 1, W, E, seed=seed + 6),
    )


# ---------------------------------------------------------------- against other solvers


@pytest.mark.parametrize("seed", [0, 10, 20])
def test_the_chain_is_solved_as_gtsam_does(seed: int) -> None:
    """Mean and all covariances of the same Gaussian factor graph."""
    gtsam = pytest.importorskip("gtsam")
    made = chain(seed)
    graph, unit = gtsam.GaussianFactorGraph(), gtsam.noiseModel.Unit.Create(E)

    def whitened(covariance: Tensor) -> np.ndarray:
        return np.linalg.inv(np.linalg.cholesky(covariance[0, 0].numpy()))

    root = whitened(made.covariance)
    graph.add(gtsam.JacobianFactor(0, root, root @ made.mean[0, 0].numpy(), unit))
    for k in range(W):
        graph.add(
            gtsam.HessianFactor(
                k, made.precision[0, 0, k].numpy(), made.vector[0, 0, k].numpy(), 0.0
            )
        )
        if k < W - 1:
            root = whitened(made.noise[:, :, k])
            f, d = made.transition[0, 0, k].numpy(), made.offset[0, 0, k].numpy()
            graph.add(gtsam.JacobianFactor(k, -root @ f, k + 1, root, root @ d, unit))
    solution, found = graph.optimize(), smooth(made)
    for k in range(W):
        np.testing.assert_allclose(found.mean[0, 0, k], solution.at(k), rtol=1e-7, atol=1e-8)
    hessian, _ = graph.hessian()
    expected = np.linalg.inv(hessian).reshape(W, E, W, E).transpose(0, 2, 1, 3)
    np.testing.assert_allclose(found.joint()[0, 0], expected, rtol=1e-6, atol=1e-8)


def test_noise_of_less_than_full_rank_is_no_obstacle() -> None:
    """As the limit of noise that has it."""
    made = chain(3, rank=2)
    exact = smooth(made)
    wider = made.noise + 1e-9 * torch.eye(E).double()
    near = smooth(Chain(**{**made.__dict__, "noise": wider}))
    torch.testing.assert_close(exact.mean, near.mean, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(exact.covariance, near.covariance, rtol=1e-5, atol=1e-6)


def test_marginalization_loses_nothing() -> None:
    """A window that starts a step later, from what was marginalized, ends the same."""
    made = chain(4)
    whole = smooth(made)
    rest = smooth(
        Chain(
            whole.next_mean,
            whole.next_covariance,
            made.transition[:, :, 1:],
            made.offset[:, :, 1:],
            made.noise[:, :, 1:],
            made.precision[:, :, 1:],
            made.vector[:, :, 1:],
        )
    )
    torch.testing.assert_close(rest.mean, whole.mean[:, :, 1:], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(rest.covariance, whole.covariance[:, :, 1:], rtol=1e-9, atol=1e-9)


def test_ties_are_those_of_both_graphs_at_once() -> None:
    """Two windows and linear measurements between them, solved in one (NumPy), with the partner's
    states as unknowns."""
    d = 2
    own, theirs = smooth(chain(5)), smooth(chain(6))
    sigma, other = own.joint(), theirs.joint()
    j, g = normal(1, 1, W, 1, 1, E, seed=7), normal(1, 1, W, 1, 1, d, seed=8)
    r, variance = normal(1, 1, W, 1, 1, seed=9), torch.full((1, 1, W, 1, 1), 0.3).double()
    mask = torch.tensor([True, True, False, True, True]).view(1, 1, W, 1)
    none = torch.zeros(1, 1, 1, W, d, 0).double()
    tracks = Tracks(none.sum(-1), other[..., :d, :d].unsqueeze(2), mask.mT, none)

    def linearize(delta: Tensor) -> list[Block]:
        moved = (j @ delta[:, :, :, None, :, None])[..., 0]
        return [Block(r - moved, j, variance, mask, g, torch.zeros_like(variance))]

    found = tie(sigma, tracks, linearize, robust="none")
    flat = [x[0, 0].transpose(1, 2).reshape(W * k, W * k).numpy()
            for x, k in ((sigma, E), (other[..., :d, :d], d))]  # fmt: skip
    information = np.zeros((W * (E + d), W * (E + d)))
    information[: W * E, : W * E] = np.linalg.inv(flat[0])
    information[W * E :, W * E :] = np.linalg.inv(flat[1])
    rows = np.zeros((W, W * (E + d)))
    for k in range(W):
        rows[k, k * E : (k + 1) * E] = j[0, 0, k, 0, 0]
        rows[k, W * E + k * d : W * E + (k + 1) * d] = g[0, 0, k, 0, 0]
    keep = mask[0, 0, :, 0].numpy()
    information += rows[keep].T @ rows[keep] / 0.3
    covariance = np.linalg.inv(information)
    delta = covariance @ rows[keep].T @ r[0, 0, keep, 0, 0].numpy() / 0.3
    np.testing.assert_allclose(found.delta.flatten(), delta[: W * E], rtol=1e-7, atol=1e-9)
    last = covariance[(W - 1) * E : W * E, (W - 1) * E : W * E]
    np.testing.assert_allclose(found.covariance[0, 0], last, rtol=1e-7, atol=1e-9)


def test_messages_hold_positions_and_their_covariance() -> None:
    found = smooth(chain(1))
    message = condensed(found.mean[..., :2], found.joint())
    assert message.shape == (1, 1, W * 2 + (W * 2) ** 2)
    torch.testing.assert_close(message[0, 0, : W * 2], found.mean[0, 0, :, :2].flatten())


# ---------------------------------------------------------------- in worlds


def linear() -> Scenario:
    """Constant velocity and fixes of the position: what a Kalman filter solves exactly."""
    sensors = (PositionFix(std=0.3),)
    return Scenario(
        name="linear",
        arena=Arena(2, 3, 0.1, (0.0, 0.0), (10.0, 8.0)),
        horizon=100,
        motion=RandomVelocity(),
        sensors=sensors,
        network=Network(),
        prior=Prior(position_std=0.5, velocity_std=0.5),
        process=ConstantVelocity(accel_std=0.7),
        believed_sensors=sensors,
    )


@pytest.mark.parametrize("window", [2, 6])
def test_in_a_linear_world_it_is_the_kalman_filter(window: int, tools: SimpleNamespace) -> None:
    scenario = linear()
    smoother = make("dfgo:robust=none", scenario, window=window)
    own = tools.play(smoother, scenario, [0, 1], 12)
    kalman = tools.play(make("ekf", scenario), scenario, [0, 1], 12)
    for one, other in zip(own.estimates, kalman.estimates, strict=True):
        torch.testing.assert_close(one.position, other.position, rtol=1e-8, atol=1e-8)
        torch.testing.assert_close(one.covariance, other.covariance, rtol=1e-6, atol=1e-10)


def test_the_teams_graph_is_the_joint_kalman_filter(tools: SimpleNamespace) -> None:
    """But for linearization: where landmarks pin attitudes, ranges are all but linear."""
    scenario = make_scenario("indoor-v0", landmarks=30)
    run = tools.play(make("dfgo_central:robust=none:window=6", scenario), scenario, [0, 1], 25)
    joint = tools.replay(make("ekf_joint", scenario), run.observations)
    apart = (run.position[-1] - joint.position[-1]).norm(dim=-1)
    sigma = joint.estimates[-1].covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    assert (apart < 0.15 * sigma).all()
    torch.testing.assert_close(
        run.estimates[-1].covariance, joint.estimates[-1].covariance, rtol=0.05, atol=2e-5
    )


def test_the_room_is_localized_consistently(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0")
    found = tools.score("dfgo:window=8", scenario, 6, 40)
    kalman = tools.score("ekf", scenario, 6, 40)
    assert found.rmse < 1.1 * kalman.rmse
    assert 2.0 < found.nees.mean() < 3.7
    alone = tools.score("dfgo:window=8:exchange=none", scenario, 6, 40)
    assert found.rmse < alone.rmse


def test_estimates_of_others_never_come_back(tools: SimpleNamespace) -> None:
    """What a UAV sends does not depend on any range: nothing counts twice."""
    scenario = make_scenario("indoor-v0", landmarks=6)
    localizer: Any = make("dfgo:window=4", scenario)
    run = tools.play(localizer, scenario, [0], 5)
    shifted = [tools.change(o, ranges=o["ranges"] + 0.5) for o in run.observations]
    moved = tools.replay(localizer, shifted)
    assert (moved.position[-1] - run.position[-1]).abs().max() > 1e-4
    assert torch.equal(moved.beliefs[-1].sent, run.beliefs[-1].sent)
    assert torch.equal(moved.beliefs[-1].states, run.beliefs[-1].states)


def test_unheard_messages_leave_no_trace(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", message_loss=1.0)
    alone = make("dfgo:window=4:exchange=none", scenario)
    run = tools.play(make("dfgo:window=4", scenario), scenario, [0], 4)
    other = tools.replay(alone, run.observations)
    torch.testing.assert_close(run.position, other.position, rtol=0, atol=1e-12)


@pytest.mark.parametrize("text", ["window=1", "exchange=some", "robust=gate"])
def test_bad_options_are_refused_in_a_line(text: str) -> None:
    with pytest.raises(ValueError, match=text.split("=")[0]) as error:
        make(f"dfgo:{text}", make_scenario("indoor-v0"))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["dfgo:window=4", "dfgo_central:window=3", "ukf"])
def test_names_that_are_found_rightly_are_as_good_as_given(name: str) -> None:
    """The same noise, in another order: with a narrow prior the estimates are the very same."""

    def estimates(association: str) -> Tensor:
        scenario = make_scenario(
            "indoor-v0", association=association, n_uavs=2, landmarks=6, prior_std=0.05
        )
        world, localizer = World(scenario), make(name, scenario)
        seen = world.reset([4])
        belief: Any = localizer.reset(seen)
        found = []
        for _ in range(6):
            belief, estimate = localizer.step(belief, seen)
            found.append(estimate.position)
            world.advance(estimate.action())
            seen = world.observation()
        return torch.stack(found)

    torch.testing.assert_close(estimates("unknown"), estimates("known"), rtol=0, atol=1e-9)
