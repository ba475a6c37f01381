"""Vague priors: own measurements first, then ranges between UAVs."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from agents.models.measurements import Block
from agents.models.ordered_update import gauss_newton
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import Landmarks


def found(name: str, tools: SimpleNamespace, runs: int, steps: int, **overrides: Any) -> Any:
    return tools.score(name, make_scenario("indoor-v0", **overrides), runs, steps)


@pytest.mark.parametrize("std", [10.0, 20.0, 50.0, 1e5])
def test_a_vague_prior_costs_nothing(std: float, tools: SimpleNamespace) -> None:
    ekf, joint = (found(n, tools, 10, 25, prior_std=std) for n in ("ekf", "ekf_joint"))
    near = found("ekf", tools, 10, 25, prior_std=2.0)
    assert ekf.rmse < 1.05 * near.rmse
    assert joint.rmse < 1.1 * ekf.rmse
    assert 2.0 < ekf.nees.mean() < 4.0
    assert 2.0 < joint.nees.mean() < 4.0


@pytest.mark.parametrize(
    "name", ["ekf:robust=huber+gate", "ekf:robust=ransac", "ekf_joint:robust=huber", "ekf_trust"]
)
def test_a_vague_prior_is_no_reason_to_distrust(name: str, tools: SimpleNamespace) -> None:
    vague, near = (found(name, tools, 5, 20, prior_std=std) for std in (20.0, 2.0))
    assert vague.rmse < 1.1 * near.rmse


@pytest.mark.slow
def test_a_blackout_leaves_the_team_honest(tools: SimpleNamespace) -> None:
    """20 s with ranges between UAVs alone, then landmarks again."""
    joint = found("ekf_joint", tools, 8, 500, range_only=(2.0, 22.0))
    assert joint.nees[:, 20:220].mean() < 5.0
    assert joint.nees[:, 220:].mean() < 5.0
    assert joint.nees[:, 460:].mean() < 3.5


def at_one_point(landmarks: int) -> Scenario:
    scenario = make_scenario("indoor-v0", landmarks=landmarks)

    def stacked(sensor: Any) -> Any:
        if not isinstance(sensor, Landmarks):
            return sensor
        return replace(sensor, positions=((15.0, 10.0, 2.5),) * landmarks)

    return replace(
        scenario,
        sensors=tuple(map(stacked, scenario.sensors)),
        believed_sensors=tuple(map(stacked, scenario.believed.sensors)),
    )


def test_five_landmarks_at_one_point(tools: SimpleNamespace) -> None:
    scenario = at_one_point(5)
    ekf, joint = (tools.score(name, scenario, 12, 60) for name in ("ekf", "ekf_joint"))
    assert joint.rmse <= ekf.rmse
    assert joint.nees.mean() < 5.0


@pytest.mark.parametrize("name", ["ekf", "ekf_joint", "ekf:fusion=ci"])
@pytest.mark.parametrize("anchors", [1, 2])
def test_what_nothing_observes_stays_finite(
    name: str, anchors: int, tools: SimpleNamespace
) -> None:
    scenario = make_scenario("indoor-v0", landmarks=0, anchors=anchors, prior_std=1e5)
    for estimate in tools.play(tools.build(name, scenario), scenario, [0, 1], 20).estimates:
        assert estimate.position.isfinite().all()
        assert (torch.linalg.eigvalsh(estimate.covariance) > 0).all()


def test_without_any_measurement_the_team_reckons_dead(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", landmarks=0, uwb=False)
    joint, alone = (
        tools.play(tools.build(name, scenario), scenario, [0], 5)
        for name in ("ekf_joint", "dead_reckoning")
    )
    torch.testing.assert_close(joint.position, alone.position)
    torch.testing.assert_close(joint.estimates[-1].covariance, alone.estimates[-1].covariance)


# ---------------------------------------------------------------- parts


@pytest.mark.parametrize("spread", [0.5, 5.0, 50.0])
def test_gauss_newton_finds_the_least_squares(spread: float) -> None:
    """scipy's minimum, of ranges to five anchors about a Gaussian prior."""
    g = np.random.default_rng(0)
    anchors, std = g.uniform(-10, 10, (5, 3)), 0.1
    covariance = np.diag(spread**2 * g.uniform(0.5, 2.0, 3))
    truth, mean = np.array([1.0, -2.0, 3.0]), np.array([2.0, -1.0, 4.0])
    z = np.linalg.norm(truth - anchors, axis=-1) + std * g.normal(size=5)

    def whitened(p: np.ndarray) -> np.ndarray:
        off = np.linalg.solve(np.linalg.cholesky(covariance), p - mean)
        return np.concatenate((off, (z - np.linalg.norm(p - anchors, axis=-1)) / std))

    def information(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        apart = x.unsqueeze(-2) - torch.tensor(anchors)
        h = apart / apart.norm(dim=-1, keepdim=True)
        r = torch.tensor(z) - apart.norm(dim=-1)
        return h.mT @ h / std**2, (h.mT @ r.unsqueeze(-1))[..., 0] / std**2

    exact = least_squares(whitened, mean, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    x, p = torch.tensor(mean)[None, None], torch.tensor(covariance)[None, None]
    state, updated = gauss_newton(x, p, information, torch.add, 20)
    np.testing.assert_allclose(state[0, 0], exact.x, atol=1e-4)
    np.testing.assert_allclose(updated[0, 0], np.linalg.inv(exact.jac.T @ exact.jac), rtol=1e-3)


def test_a_bent_range_has_the_variance_of_what_linearizing_neglects() -> None:
    """Sampled: ‖a + δ‖ less ‖a‖ + u·δ, for a relative position known to 0.7 m."""
    g = torch.Generator().manual_seed(1)
    apart, spread = torch.tensor([4.0, 3.0, 0.0]).double(), 0.7
    delta = spread * torch.randn(200_000, 3, generator=g).double()
    unit, distance = apart / apart.norm(), apart.norm()
    neglected = (apart + delta).norm(dim=-1) - distance - delta @ unit
    block = Block(
        residual=torch.zeros(1, 1, 1, 1).double(),
        jacobian=torch.zeros(1, 1, 1, 1, 3).double(),
        variance=torch.full((1, 1, 1, 1), 0.01).double(),
        mask=torch.ones(1, 1, 1, dtype=torch.bool),
        partner=-unit.view(1, 1, 1, 1, 3),
        distance=distance.view(1, 1, 1, 1),
    )
    covariance = (spread**2 * torch.eye(3)).double()[None, None, None]
    added = float(block.bent(covariance, 1.0).variance) - 0.01
    assert added == pytest.approx(float(neglected.var()), rel=0.1)
