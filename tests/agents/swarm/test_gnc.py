"""Graduated non-convexity and several starts, against scipy and the equations' own definition."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from agents import make
from agents.swarm import weights
from agents.swarm.confidence import GncConfidence
from agents.swarm.gauss_newton import gauss_newton
from agents.swarm.links import Links
from agents.swarm.multi_start import best_of, starts_about
from coloc_env import make_scenario

STD = 0.5
CORNERS = torch.tensor([[0, 0], [40, 0], [0, 40], [40, 40], [20, 45], [45, 20.0], [-5, 20]])
PLACE = torch.tensor([14.0, 23.0])


@given(st.floats(0.0, 200.0), st.floats(0.01, 100.0))
def test_weights_are_the_surrogates(squared: float, mu: float) -> None:
    """w minimizes w r̂² + μ (1 − w) / (μ + w) c̄² over [0, 1] (GNC, equations 8 and 13)."""
    w = torch.linspace(0, 1, 4001, dtype=torch.float64)
    cost = w * squared + mu * (1 - w) / (mu + w) * weights.TRUNCATED
    mu_ = torch.tensor([[[mu]]], dtype=torch.float64)
    found = weights.truncated(torch.tensor([[[squared]]], dtype=torch.float64), mu_)
    at = float(found * squared + mu * (1 - found) / (mu + found) * weights.TRUNCATED)
    assert at <= float(cost.min()) + 1e-6


def test_the_first_surrogate_is_convex_and_inliers_need_none() -> None:
    squared = torch.tensor([[[400.0, 1.0], [1.0, 4.0]]], dtype=torch.float64)
    assert float(weights.first_mu(squared)) == pytest.approx(9 / (2 * 400 - 9))
    inliers = squared.clamp_max(4.0)
    assert bool((weights.truncated(inliers, weights.first_mu(inliers)) == 1).all())


def _trilateration(off: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """One UAV among fixed ones; ranges that are ``off`` m: y, distances, who is fixed, Λ = 0."""
    y = torch.cat((PLACE.unsqueeze(0) + 6.0, CORNERS)).double().unsqueeze(0)
    n = y.shape[1]
    distance = torch.zeros(1, n, n, dtype=torch.float64)
    distance[0, 0, 1:] = (CORNERS - PLACE).norm(dim=-1) + off
    distance = distance + distance.mT
    fixed = torch.ones(1, n, dtype=torch.bool)
    fixed[0, 0] = False
    return y, distance, fixed, torch.zeros(1, 2 * n, 2 * n, dtype=torch.float64)


def test_three_of_seven_ranges_too_long() -> None:
    """What is left is scipy's least squares of the others; Huber's weights are pulled away."""
    generator = torch.Generator().manual_seed(0)
    off = 0.3 * STD * torch.randn(7, generator=generator)
    inliers = torch.tensor([0, 2, 4, 6])
    off[[1, 3, 5]] += torch.tensor([25.0, 18.0, 30.0])
    y, distance, fixed, nothing = _trilateration(off)
    mask = distance > 0
    inputs: Any = SimpleNamespace(links=Links(distance, mask))
    graduated, iterations = GncConfidence(STD).schedule(inputs, 1)
    found = gauss_newton(y, distance, graduated, fixed, y, nothing, iterations)[0][0, 0]
    ends, measured = CORNERS[inliers].numpy(), distance[0, 0, 1:][inliers].numpy()
    reference = least_squares(
        lambda p: (((ends - p) ** 2).sum(1) ** 0.5 - measured) / STD, PLACE.numpy() + 6.0
    ).x
    assert torch.allclose(found, torch.from_numpy(reference), atol=1e-3)

    def huber(residual: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return weights.huber(residual, mask, torch.zeros_like(residual), STD)

    pulled = gauss_newton(y, distance, huber, fixed, y, nothing, 25)[0][0, 0]
    assert float((pulled - PLACE).norm()) > 5 * float((found - PLACE).norm())


def test_the_best_of_several_starts_is_taken_world_by_world() -> None:
    """x² has its least at 0 in the first world; (x − 3)² in the other: a solver that stays where it
    is started ends at the best start of each."""
    goal = torch.tensor([[[0.0, 0.0]], [[3.0, 0.0]]], dtype=torch.float64)
    starts = list(
        starts_about(torch.full((2, 1, 2), 2.0).double(), torch.full((2, 1), 4.0).double(), 9)
    )
    assert torch.equal(starts[0], torch.full((2, 1, 2), 2.0).double())
    cost = lambda at, delay: (at - goal).square().sum((-2, -1))  # noqa: E731
    position, _ = best_of(lambda at: (at, at), cost, iter(starts))
    each = torch.stack([cost(at, at) for at in starts])
    assert torch.equal(cost(position, position), each.min(0).values)
    assert len(set(each.argmin(0).tolist())) == 2


def test_bad_options_are_refused_in_one_line() -> None:
    scenario = make_scenario("swarm-v0", n_uavs=5)
    with pytest.raises(ValueError, match="starts=3 is not allowed with confidence=em"):
        make("map:starts=3", scenario)
    with pytest.raises(ValueError, match="confidence"):
        make("dwmds_st:confidence=gnc", scenario)
