"""The bank of Kalman filters: its starts, its weights, and what it finds."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from agents import make
from agents.association.clutter import CLUTTER
from agents.kalman.hypotheses import log_predictive, merged, reweighed
from agents.models.measurements import Block
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

LOST = {"prior": "uniform", "prior_yaw": "uniform", "max_speed": 1.0}


def test_starts_have_the_priors_moments() -> None:
    """Mean and covariance of the error over all hypotheses, in the prior's tangent space."""
    scenario = make_scenario("indoor-v0", association="unknown", **LOST)
    bank: Any = make("mhekf", scenario)
    seen = World(scenario, 2).reset(0)
    one, many = bank.ekf.reset(seen), bank.reset(seen)
    assert many.state.shape[2] == 64
    apart = bank.process.boxminus(many.state, one.state.unsqueeze(2).expand_as(many.state))
    torch.testing.assert_close(apart.mean(2), torch.zeros_like(apart[:, :, 0]), atol=1e-2, rtol=0.0)
    spread = apart.mT @ apart / 64 + many.covariance.mean(2)
    torch.testing.assert_close(spread, one.covariance, atol=2e-2, rtol=2e-2)
    assert (torch.linalg.eigvalsh(many.covariance) > 0).all()


def test_a_narrow_prior_is_one_hypothesis(tools: SimpleNamespace) -> None:
    """And the bank is the filter."""
    scenario = make_scenario("indoor-v0")
    bank, ekf = (tools.play(make(n, scenario), scenario, [1], 3) for n in ("mhekf", "ekf"))
    torch.testing.assert_close(bank.position, ekf.position, rtol=0.0, atol=0.0)


def test_predictive_density() -> None:
    g = torch.Generator().manual_seed(0)
    h = torch.randn(1, 1, 4, 2, 3, generator=g, dtype=torch.float64)
    r = torch.randn(1, 1, 4, 2, generator=g, dtype=torch.float64)
    mask = torch.tensor([[[True, True, False, True]]])
    block = Block(r, h, torch.full_like(r, 0.09), mask)
    p = torch.diag(torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64))
    expected = 0.0
    for m in (0, 1, 3):
        s = (h[0, 0, m] @ p @ h[0, 0, m].T).numpy() + 0.09 * np.eye(2)
        near, far = (multivariate_normal.pdf(r[0, 0, m], cov=c) for c in (s, 100 * np.eye(2)))
        expected += math.log((1 - CLUTTER) * near + CLUTTER * far)
    assert float(log_predictive(block, p[None, None])) == pytest.approx(expected, rel=1e-10)


def test_the_same_pose_is_one_hypothesis() -> None:
    """The lighter of two that agree goes over to the heavier; a third elsewhere stays."""
    bank: Any = make("mhekf", make_scenario("indoor-v0"))
    state = torch.zeros(1, 1, 3, 10, dtype=torch.float64)
    state[..., 6] = 1.0
    state[0, 0, :, 0] = torch.tensor([0.0, 0.1, 5.0])
    p = torch.eye(9, dtype=torch.float64).expand(1, 1, 3, 9, 9)
    weights = torch.tensor([[[0.2, 0.5, 0.3]]], dtype=torch.float64)
    found = merged(bank.process, state, p, weights.log()).exp()
    torch.testing.assert_close(found, torch.tensor([[[0.0, 0.7, 0.3]]], dtype=torch.float64))


def test_broken_and_unlikely_hypotheses_are_given_up() -> None:
    log_weights = torch.tensor([[[0.0, -30.0, math.nan, -1.0]]], dtype=torch.float64)
    found = reweighed(log_weights).exp()
    expected = torch.tensor([1, 0, 0, math.exp(-1)], dtype=torch.float64) / (1 + math.exp(-1))
    torch.testing.assert_close(found[0, 0], expected)
    broken = reweighed(torch.full((1, 1, 2), math.nan, dtype=torch.float64)).exp()
    assert broken.tolist() == [[[0.5, 0.5]]]


@pytest.mark.slow
def test_nothing_known_at_the_start(tools: SimpleNamespace) -> None:
    """Neither place, heading, nor which landmark is which: the bank finds all UAVs, one filter
    hardly any."""
    scenario = make_scenario("indoor-v0", association="unknown", landmarks=5, **LOST)
    bank, one = (tools.score(n, scenario, 3, 100) for n in ("mhekf:hypotheses=256", "ekf"))
    assert np.median(bank.rmse_per_run) < 1.0
    assert one.rmse > 5.0
