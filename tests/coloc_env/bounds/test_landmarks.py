"""Bounds where landmarks are without names or places: GTSAM, finite differences, more knowledge."""

from typing import Any

import numpy as np
import pytest
import torch

from coloc_env.bounds import posterior_bound
from coloc_env.bounds.landmarks import LandmarkStates, known_landmarks
from coloc_env.bounds.process import error_model, prior_covariance
from coloc_env.bounds.worlds import worlds
from coloc_env.geometry import rotate_by, rotation_matrix
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario


def unmapped(**overrides: Any) -> Scenario:
    return make_scenario("indoor-v0", landmarks_known=False, **{"landmarks": 4} | overrides)


@pytest.mark.parametrize("cooperative", [True, False])
def test_it_is_the_marginal_of_gtsams_whole_graph(cooperative: bool) -> None:
    """Of a linear one: attitudes are known where the motion model has none. Without others, each
    UAV has a map of its own."""
    gtsam = pytest.importorskip("gtsam")
    scenario, steps = unmapped(imu=False, uwb=False, n_uavs=2, landmark_radius=12.0), 4
    found = posterior_bound(scenario, 1, 3, steps, cooperative).mse[0, -1]
    model, sensor = error_model(scenario), LandmarkStates.of(scenario)
    prior, seeds = prior_covariance(model, scenario).numpy(), torch.tensor([3])
    for team in ([0, 1],) if cooperative else ([0], [1]):
        graph, before = gtsam.GaussianFactorGraph(), None

        def add(covariance: np.ndarray, *blocks: Any, graph: Any = graph) -> None:
            root = np.linalg.inv(np.linalg.cholesky(covariance))
            whitened = [x if isinstance(x, int) else root @ x for x in blocks]
            unit = gtsam.noiseModel.Unit.Create(len(root))
            graph.add(gtsam.JacobianFactor(*whitened, np.zeros(len(root)), unit))

        for landmark in range(4):
            add(sensor.prior[:3, :3].numpy(), 1000 + landmark, np.eye(3))
        for k, (truth, seen, _) in enumerate(worlds(known_landmarks(scenario), seeds, steps)):
            for uav in team:
                key = 10 * k + uav
                if before is None:
                    add(prior, key, np.eye(6))
                else:
                    f, q = (x[0, uav].numpy() for x in model.transition(before, truth, seen))
                    add(q, key - 10, -f, key, np.eye(6))
                turn = rotation_matrix(truth.attitude)[0, uav].numpy().T
                by_pose = np.hstack((-turn, np.zeros((3, 3))))
                for landmark in seen["landmark_mask"][0, uav].nonzero().flatten().tolist():
                    add(0.15**2 * np.eye(3), key, by_pose, 1000 + landmark, turn)
            before = truth
        hessian, _ = graph.hessian()
        marginals = np.linalg.inv(hessian)
        for i, uav in enumerate(team):
            first = 6 * ((steps - 1) * len(team) + i)
            mse = marginals[first : first + 3, first : first + 3].trace()
            np.testing.assert_allclose(found[uav], mse, rtol=1e-6)


def test_information_is_that_of_finite_differences() -> None:
    """Of Rᵀ(L − p) by a UAV's position and attitude and by the landmarks."""
    scenario = unmapped(n_uavs=2, landmark_radius=12.0)
    states, pose = LandmarkStates.of(scenario), torch.eye(6, dtype=torch.float64)
    truth, seen, _ = next(worlds(known_landmarks(scenario), torch.tensor([3]), 1))
    own, cross, each = states.information(truth, seen, pose, 2)
    places = seen["landmark_map"][0, 0].double().view(4, 3)
    whole = torch.zeros(24, 24, dtype=torch.float64)
    for uav in (0, 1):

        def vectors(x: torch.Tensor, uav: int = uav) -> torch.Tensor:
            turned = rotate_by(truth.attitude[0, uav], x[6 * uav + 3 : 6 * uav + 6])
            where = truth.position[0, uav] + x[6 * uav : 6 * uav + 3]
            return ((places + x[12:].view(4, 3) - where) @ rotation_matrix(turned)).flatten()

        steps = 1e-5 * torch.eye(24, dtype=torch.float64)
        h = torch.stack([(vectors(s) - vectors(-s)) / 2e-5 for s in steps], 1)
        weight = seen["landmark_mask"][0, uav].double().repeat_interleave(3) / 0.15**2
        whole += h.T @ (weight.unsqueeze(-1) * h)
    assert float(each.sum()) > 0
    for uav in (0, 1):
        mine = slice(6 * uav, 6 * uav + 6)
        torch.testing.assert_close(own[0, uav], whole[mine, mine], rtol=1e-6, atol=1e-4)
    torch.testing.assert_close(cross[0], whole[:12, 12:], rtol=1e-6, atol=1e-4)
    torch.testing.assert_close(each[0].diag(), whole[12:, 12:], rtol=1e-6, atol=1e-4)


def test_a_map_is_worth_more_than_landmarks_and_these_more_than_none() -> None:
    overrides: dict[str, Any] = {"n_uavs": 3, "anchors": 4, "horizon": 15}
    known, found, none = (
        posterior_bound(scenario, runs=2).rmse
        for scenario in (
            make_scenario("indoor-v0", landmarks=4, **overrides),
            unmapped(**overrides),
            make_scenario("indoor-v0", landmarks=0, **overrides),
        )
    )
    assert known < 0.9 * found < 0.9 * none


def test_without_names_it_is_the_bound_with_names() -> None:
    named, unnamed = (
        posterior_bound(make_scenario("indoor-v0", association=one, horizon=4, n_uavs=2), runs=1)
        for one in ("known", "unknown")
    )
    assert torch.equal(named.mse, unnamed.mse)
