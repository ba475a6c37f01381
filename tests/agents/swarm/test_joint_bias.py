"""The joint covariance of biases: against filterpy's Kalman filter with the bias in its state."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from filterpy.kalman import KalmanFilter
from torch import Tensor

from agents import make
from agents.swarm import delays, ins_bias, joint, joint_bias
from agents.swarm.belief import SwarmBelief
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import Ins
from coloc_env.world import World

N, D, DT = 3, 2, 0.5
INS = Ins(std=0.4, bias=0.3, bias_time=20.0)
K = N * D


def filter_of_all(variance: float) -> KalmanFilter:
    """Positions and biases of all UAVs in one state."""
    phi = np.exp(-DT / INS.bias_time)
    kf = KalmanFilter(dim_x=2 * K, dim_z=2)
    # the bias decays first, then the position moves by it
    kf.F = np.block([[np.eye(K), -DT * phi * np.eye(K)], [np.zeros((K, K)), phi * np.eye(K)]])
    white = INS.bias**2 * (1 - phi**2)
    drift = np.block([[DT**2 * np.eye(K), -DT * np.eye(K)], [-DT * np.eye(K), np.eye(K)]])
    kf.Q = white * drift
    kf.Q[:K, :K] += (DT * INS.std) ** 2 * np.eye(K)
    kf.x = np.zeros(2 * K)
    kf.P = np.diag([variance] * K + [INS.bias**2] * K)
    return kf


def test_it_is_a_kalman_filter_of_positions_and_biases() -> None:
    """With linear measurements of differences between UAVs, step by step."""
    rng, variance = np.random.default_rng(0), 4.0
    kf = filter_of_all(variance)
    place = torch.zeros(1, N, D, dtype=torch.float64)
    nothing = delays.initial(place, None)
    covariance = joint.independent(torch.full((1, N), variance, dtype=torch.float64), D)
    bias = ins_bias.initial(place, INS)
    known = joint_bias.initial(place, nothing, INS, True)
    dt = torch.full((1, N), DT, dtype=torch.float64)
    x, noise = np.zeros(K), 0.5
    for k in range(12):
        kf.predict()
        bias = ins_bias.decay(bias, dt, INS)
        known = joint_bias.decay(known, dt, INS)
        x = x - DT * bias.bias.numpy().ravel()
        known, covariance, nothing = joint_bias.predict(known, covariance, nothing, dt, INS)
        h = np.zeros((2, K))
        i, j = rng.choice(N, 2, replace=False)
        h[:, D * i : D * i + D], h[:, D * j : D * j + D] = np.eye(D), -np.eye(D)
        if k % 4 == 0:  # and positions themselves, that all is observable
            h[:, D * j : D * j + D] = 0.0
        z = rng.normal(size=2)
        kf.update(z, R=noise * np.eye(2), H=np.hstack((h, np.zeros((2, K)))))
        p = covariance.flatten(1, 2)
        precision = torch.linalg.inv(p)
        information = torch.from_numpy(h.T @ h / noise)
        posterior = torch.linalg.inv(precision + information)
        moved = posterior @ torch.from_numpy(h.T @ (z - h @ x) / noise)
        bias, known = joint_bias.update(bias, known, moved, precision, posterior)
        x, covariance = x + moved[0].numpy(), posterior.unflatten(1, (N, D))
        np.testing.assert_allclose(x, kf.x[:K], atol=1e-10)
        np.testing.assert_allclose(bias.bias.numpy().ravel(), kf.x[K:], atol=1e-10)
        np.testing.assert_allclose(known.own.flatten(1, 2)[0], kf.P[K:, K:], atol=1e-10)
        np.testing.assert_allclose(known.known.flatten(1, 2)[0], kf.P[K:, :K], atol=1e-10)


def test_a_fix_corrects_its_own_bias_as_a_kalman_filter_would() -> None:
    kf, r = filter_of_all(4.0), 0.01
    place = torch.zeros(1, N, D, dtype=torch.float64)
    nothing = delays.initial(place, None)
    covariance = joint.independent(torch.full((1, N), 4.0, dtype=torch.float64), D)
    known = joint_bias.initial(place, nothing, INS, True)
    dt = torch.full((1, N), DT, dtype=torch.float64)
    bias = ins_bias.decay(ins_bias.initial(place, INS), dt, INS)
    known = joint_bias.decay(known, dt, INS)
    known, covariance, nothing = joint_bias.predict(known, covariance, nothing, dt, INS)
    kf.predict()
    fixed = torch.tensor([[False, True, False]])
    innovation = torch.tensor([[[0.0, 0.0], [0.7, -0.2], [0.0, 0.0]]], dtype=torch.float64)
    bias, known = joint_bias.at_fixes(bias, known, covariance, nothing, fixed, innovation, r)
    h = np.zeros((2, 2 * K))
    h[:, D : 2 * D] = np.eye(D)
    kf.update(innovation[0, 1].numpy(), R=r * np.eye(2), H=h)
    np.testing.assert_allclose(bias.bias.numpy().ravel(), kf.x[K:], atol=1e-12)
    np.testing.assert_allclose(known.own.flatten(1, 2)[0], kf.P[K:, K:], atol=1e-12)
    assert not known.known[..., D : 2 * D].any()  # a fixed position is independent of biases


def covariance_of_all(belief: SwarmBelief) -> Tensor:
    """Of positions, delays and biases."""
    x = delays.joint_covariance(belief.joint, belief.delays)
    known, own = belief.joint_bias.known.flatten(1, 2), belief.joint_bias.own.flatten(1, 2)
    return torch.cat((torch.cat((x, known.mT), -1), torch.cat((known, own), -1)), -2)


def test_the_covariance_of_all_stays_positive() -> None:
    scenario = make_scenario("campus-v0", flight="s1")
    localizer, world = make("map", scenario), World(scenario, 1)
    observation = world.reset(torch.arange(1))
    belief = localizer.reset(observation)
    for _ in range(20):
        belief, estimate = localizer.step(belief, observation)
        assert float(torch.linalg.eigvalsh(covariance_of_all(belief)).min()) > 0
        world.advance(estimate.action())
        observation = world.observation()


@pytest.mark.parametrize("factors", ["ep", "weights"])
def test_without_a_bias_nothing_is_kept_and_nothing_changes(factors: str) -> None:
    scenario = make_scenario("swarm-v0", n_uavs=12, ins_bias=0.0)
    found = []
    for bias in ("joint", "own", "none"):
        localizer = make(f"map:factors={factors}:bias={bias}", scenario)
        world = World(scenario, 1)
        observation = world.reset(torch.arange(1))
        belief = localizer.reset(observation)
        for _ in range(3):
            belief, estimate = localizer.step(belief, observation)
            world.advance(estimate.action())
            observation = world.observation()
        assert belief.joint_bias.own.shape[-1] == 0
        found.append(estimate)
    for other in found[1:]:
        assert torch.equal(found[0].position, other.position)
        assert torch.equal(found[0].covariance, other.covariance)


@pytest.mark.slow
def test_it_pays_where_biases_are_large(tools: SimpleNamespace) -> None:
    scenario = make_scenario(
        "swarm-v0", n_uavs=30, size=(5313.0, 5313.0, 2657.0), comm_radius=1500.0, ins_bias=1.0
    )
    errors = [
        tools.score(f"map:factors=weights:bias={bias}", scenario, 2, 60).rmse
        for bias in ("joint", "own")
    ]
    assert errors[0] < 0.95 * errors[1]
