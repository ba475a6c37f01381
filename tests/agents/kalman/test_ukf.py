"""The unscented filter: filterpy's, step by step, and as good as the bound allows."""

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from agents import make
from agents.models.measurements import received
from coloc_env.bounds import posterior_bound
from coloc_env.scenarios import make_scenario


@pytest.mark.parametrize("alpha", [0.3, 1.0])
@pytest.mark.parametrize(
    "overrides", [{}, {"imu_bias": True}, {"landmarks": 4, "anchors": 3}], ids=str
)
def test_a_step_is_filterpys(overrides: dict, alpha: float, tools: SimpleNamespace) -> None:
    """One UAV's second step in the tangent space of its propagated mean, where the textbook's
    filter has vectors: mean and covariance to 1e-9."""
    scenario = make_scenario("indoor-v0", **overrides)
    localizer: Any = make("ukf", scenario, alpha=alpha)
    process, run = localizer.process, tools.play(localizer, scenario, [5], 2)
    belief, seen, uav = run.beliefs[1], run.observations[1], 2
    e, dt = process.error_size, torch.full((1, 1), process.dt).double()  # as the filter has it
    x, u = belief.state[:, uav : uav + 1], process.inputs(seen)[:, uav : uav + 1]
    mine = tools.change(seen, **{k: v[:, uav : uav + 1] for k, v in seen.leaves.items()})
    neighbours = received(scenario.believed, mine)
    centre = process.propagate(x, u, dt)

    def moved(delta: np.ndarray, _: float) -> np.ndarray:
        start = process.boxplus(x, torch.from_numpy(delta)[None, None])
        return process.boxminus(process.propagate(start, u, dt), centre)[0, 0].numpy()

    def measured(delta: np.ndarray, at: torch.Tensor, models: Any) -> np.ndarray:
        """h(x) − z of what was measured."""
        state = process.boxplus(at, torch.from_numpy(delta)[None, None])
        blocks = [m.linearize(process, state, mine, neighbours) for m in models]
        return torch.cat([-block.residual[block.mask].flatten() for block in blocks]).numpy()

    points = MerweScaledSigmaPoints(e, alpha, 2.0, 0.0)
    textbook = UnscentedKalmanFilter(e, 1, process.dt, None, moved, points)
    textbook.P = belief.covariance[0, uav].numpy()
    textbook.Q = process.linearize(x, u, dt)[1][0, 0].numpy()
    textbook.predict()
    state = process.boxplus(centre, torch.from_numpy(textbook.x)[None, None])
    for cooperative in (False, True):  # each in the tangent space of the mean before it
        models = [m for m in localizer.models if m.cooperative == cooperative]
        blocks = [m.linearize(process, state, mine, neighbours) for m in models]
        variances = torch.cat([b.total_variance[b.mask].flatten() for b in blocks])
        assert len(variances) > 4
        textbook.x = np.zeros(e)
        textbook.sigmas_f = points.sigma_points(textbook.x, textbook.P)
        size = np.zeros(len(variances))
        textbook._dim_z, textbook.sigmas_h = len(size), np.zeros((2 * e + 1, len(size)))
        textbook.update(size, np.diag(variances), hx=partial(measured, at=state, models=models))
        state = process.boxplus(state, torch.from_numpy(textbook.x)[None, None])
    after = run.beliefs[2]
    torch.testing.assert_close(after.state[:, uav : uav + 1], state, rtol=0, atol=1e-9)
    found = after.covariance[0, uav].numpy()
    np.testing.assert_allclose(found, textbook.P, rtol=0, atol=1e-9)


def test_the_room_is_localized_to_the_bound(tools: SimpleNamespace) -> None:
    """Once it has settled: it does not iterate, so its first steps are worse than the EKF's."""
    scenario = make_scenario("indoor-v0", n_uavs=3)
    found = tools.score("ukf", scenario, 4, 60)
    late = found.nees[:, 30:]
    assert 2.3 < late.mean() < 3.8
    assert found.rmse < 1.6 * posterior_bound(scenario, 4, 0, 60).rmse
