"""Factors of ranges by expectation propagation, against quadrature and a Kalman filter."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import norm
from torch import Tensor

from agents.swarm import delays, joint
from agents.swarm.belief import StepInput
from agents.swarm.calibration import ErrorModel, prior_model
from agents.swarm.expectation_propagation import (
    DAMPING,
    Cavity,
    Sites,
    cavity,
    length_variance,
    sites_by_moments,
)
from agents.swarm.links import Links, lengths
from agents.swarm.persistence import prior_counts
from coloc_env.sensors import Clock

STD = 10.0
SHARE, BIAS, SPREAD = 0.3, 25.0, 18.0  # of NLOS ranges


def scalar(value: float) -> Tensor:
    return torch.tensor([[[value]]], dtype=torch.float64)


def inputs_of(links: int = 1) -> StepInput:
    """A step of one team whose error model is the mixture above."""
    other = (SHARE, SHARE * BIAS, SHARE * (SPREAD**2 + BIAS**2))
    sums = torch.tensor([[(1 - SHARE, 0.0, (1 - SHARE) * STD**2), other]], dtype=torch.float64)
    zero = torch.zeros(1, links, links, dtype=torch.float64)
    place = torch.zeros(1, links, 3, dtype=torch.float64)
    return StepInput(
        state=torch.cat((place, place), -1),
        prior=place,
        variance=zero[..., 0],
        process_noise=zero[..., 0],
        fixed=zero[..., 0] > 0,
        links=Links(zero, zero == 0),
        error_model=ErrorModel(sums=sums, batch_size=(1,)),
        predicted_variance=zero[..., 0],
        joint=zero[..., None][..., :0],
        pair_variance=zero,
        ins_bias=None,
        transitions=prior_counts(torch.full((1,), SHARE, dtype=torch.float64)),
        delays=delays.initial(place, None),
    )


def moments_by_quadrature(residual: float, variance: float) -> tuple[float, float, float]:
    """Mean and variance of the length z ~ N(0, variance) whose range is ``residual`` longer than
    expected, and the probability that it is NLOS."""
    width = variance**0.5

    def weighed(z: float, power: int, component: int) -> float:
        e = residual - z
        p = (1 - SHARE) * norm.pdf(e, 0, STD), SHARE * norm.pdf(e, BIAS, SPREAD)
        return float(z**power * norm.pdf(z, 0, width) * p[component])

    def total(power: int, *components: int) -> float:
        around = sorted((-8 * width, 0.0, residual, residual - BIAS, 8 * width))
        low, high = -8 * width, 8 * width
        points = [x for x in around if low < x < high]
        return sum(
            quad(weighed, low, high, (power, k), points=points, limit=400, epsabs=1e-14)[0]
            for k in components
        )

    mass = total(0, 0, 1)
    mean = total(1, 0, 1) / mass
    return mean, total(2, 0, 1) / mass - mean**2, total(0, 1) / mass


@settings(max_examples=25, deadline=None)
@given(st.floats(-30.0, 70.0), st.floats(4.0, 400.0))
def test_sites_have_the_moments_of_quadrature(residual: float, variance: float) -> None:
    mean, spread, outlier = moments_by_quadrature(residual, variance)
    found = sites_by_moments(Cavity(scalar(residual), scalar(variance)), inputs_of(), STD, None)
    w = float(found.weight)
    assert float(found.outlier) == pytest.approx(outlier, rel=1e-6, abs=1e-9)
    precision = 1 / variance + w  # of the cavity and the site
    assert w * (residual - float(found.shift)) / precision == pytest.approx(mean, abs=1e-6)
    exact = 1 / spread - 1 / variance
    if 1e-6 < exact < 1 / STD**2:
        assert 1 / precision == pytest.approx(spread, rel=1e-6)
    else:
        assert w == pytest.approx(1e-6 if exact <= 1e-6 else 1 / STD**2)


def test_a_site_of_one_component_is_its_gaussian() -> None:
    """Without NLOS the site is the range itself, whatever the cavity."""
    model = prior_model(1, STD, torch.device("cpu"))
    sure = replace(inputs_of(), error_model=model, outlier_probability=scalar(1e-12))
    at = Cavity(scalar(3.0), scalar(50.0))
    found = sites_by_moments(at, sure, STD, None)
    assert float(found.weight) == pytest.approx(1 / STD**2, rel=1e-6)
    assert float(found.shift) == pytest.approx(0.0, abs=1e-6)


@given(st.floats(-20.0, 20.0), st.floats(1.0, 300.0), st.floats(1e-4, 1e-2), st.floats(-5.0, 30.0))
def test_cavity_and_site_make_the_posterior(
    residual: float, variance: float, weight: float, shift: float
) -> None:
    """N(cavity) times the site is the posterior that the cavity was taken from."""
    weight = min(weight, 0.9 / variance)
    nothing = scalar(0.0)
    at = cavity(scalar(residual), scalar(variance), Sites(scalar(weight), scalar(shift), nothing))
    tau = 1 / float(at.variance)
    assert tau + weight == pytest.approx(1 / variance, rel=1e-9)
    # lengths are counted from the posterior's mean: the cavity's is r − r_c, the site's r − shift
    mean = tau * (residual - float(at.residual)) + weight * (residual - shift)
    assert mean == pytest.approx(0.0, abs=1e-9)


def test_damping_is_in_natural_parameters() -> None:
    at, before = Cavity(scalar(12.0), scalar(80.0)), Sites(scalar(0.004), scalar(9.0), scalar(0.0))
    new = sites_by_moments(at, inputs_of(), STD, None)
    found = sites_by_moments(at, inputs_of(), STD, before)

    def mixed(name: str) -> Tensor:
        return DAMPING * getattr(new, name) + (1 - DAMPING) * getattr(before, name)

    torch.testing.assert_close(found.weight, mixed("weight"))
    pull = [(one.weight * (12.0 - one.shift)) for one in (found, new, before)]
    torch.testing.assert_close(pull[0], DAMPING * pull[1] + (1 - DAMPING) * pull[2])


@pytest.mark.parametrize("clock", [None, Clock(0.2, 0.1, 300.0)])
def test_variance_of_lengths_is_that_of_their_jacobian(clock: Clock | None) -> None:
    generator = torch.Generator().manual_seed(1)
    n, d = 4, 3
    y = 50 * torch.randn(1, n, d, generator=generator, dtype=torch.float64)
    size = n * d + (0 if clock is None else 2 * n)
    root = torch.randn(1, size, size, generator=generator, dtype=torch.float64)
    whole = root @ root.mT
    delay = torch.zeros(1, n, 2, dtype=torch.float64)
    covariance, known = delays.split(whole, delay, d)

    def ranges(x: Tensor) -> Tensor:
        length = lengths(x[: n * d].view(1, n, d))[0]
        if clock is not None:
            length = length + delays.offsets(x[n * d :].view(1, n, 2))[0]
        return length

    x = torch.cat((y.flatten(), torch.zeros(size - n * d, dtype=torch.float64)))
    jacobian = torch.autograd.functional.jacobian(ranges, x)
    assert isinstance(jacobian, Tensor)
    expected = torch.einsum("ijp,pq,ijq->ij", jacobian, whole[0], jacobian)
    found = length_variance(covariance, known, y)[0]
    apart = ~torch.eye(n, dtype=torch.bool)
    np.testing.assert_allclose(found[apart], expected[apart], rtol=1e-9)
    assert joint.marginals(covariance).shape == (1, n, d, d)
