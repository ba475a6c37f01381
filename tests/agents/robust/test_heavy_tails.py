"""Densities with heavy tails and the weights that they imply, against scipy."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal, multivariate_t

from agents import make
from agents.models.measurements import Block
from agents.robust.heavy_tails import (
    DEGREES,
    OUTLIERS,
    SPREAD,
    LogDensity,
    gaussian_log_density,
    mixture_log_density,
    mixture_weights,
    student_log_density,
    student_weights,
)
from coloc_env.scenarios import make_scenario

RESIDUALS = np.random.default_rng(0).normal(0, 4, (50, 3))


def mixture(r: np.ndarray) -> np.ndarray:
    near, far = (multivariate_normal.pdf(r, np.zeros(3), c**2) for c in (1, SPREAD))
    return np.log((1 - OUTLIERS) * near + OUTLIERS * far)


@pytest.mark.parametrize(
    ("density", "expected"),
    [
        (gaussian_log_density, multivariate_normal(np.zeros(3)).logpdf),
        (student_log_density, multivariate_t(np.zeros(3), df=DEGREES).logpdf),
        (mixture_log_density, mixture),
    ],
)
def test_densities(density: LogDensity, expected: object) -> None:
    found = density(torch.from_numpy((RESIDUALS**2).sum(-1)), 3)
    np.testing.assert_allclose(found.numpy(), expected(RESIDUALS), rtol=1e-10)  # type: ignore[operator]


@pytest.mark.parametrize(
    ("density", "weights"),
    [(student_log_density, student_weights), (mixture_log_density, mixture_weights)],
)
def test_weights_are_the_slope_of_the_density(density: LogDensity, weights: object) -> None:
    """w = −2 d log p / ds, s = rᵀ R⁻¹ r."""
    r, std = torch.from_numpy(RESIDUALS), 0.3
    squared = (r**2).sum(-1).requires_grad_()
    (slope,) = torch.autograd.grad(density(squared, 3).sum(), squared)
    variance = torch.full_like(r, std**2)[None, None]
    block = Block((r * std)[None, None], r.new_zeros(0), variance, torch.ones(1, 1, 50) > 0)
    torch.testing.assert_close(weights(block)[0, 0], -2 * slope)  # type: ignore[operator]


def test_students_weight_is_one_on_average() -> None:
    """E[w s] = k under its own density: the weighted residuals have the noise's variance."""
    r = multivariate_t(np.zeros(3), df=DEGREES, seed=1).rvs(200_000)
    s = (r**2).sum(-1)
    assert ((DEGREES + 3) / (DEGREES + s) * s).mean() == pytest.approx(3, rel=0.01)


def test_one_soft_method_at_a_time() -> None:
    with pytest.raises(ValueError, match="at most one of huber, student, mixture"):
        make("ekf:robust=huber+student", make_scenario("indoor-v0"))
