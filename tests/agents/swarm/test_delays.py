"""Delays of clocks and antennas, estimated together with the team's positions."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

from agents import make
from agents.swarm import delays
from agents.swarm.gauss_newton import gauss_newton, information_matrix
from agents.swarm.links import lengths
from coloc_env.noise import row_keys
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import Clock, Ranging
from coloc_env.world import World

N, D = 5, 3
CLOCK = Clock(0.2, 0.1, 300.0)


def random(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def ranges(x: Tensor) -> Tensor:
    """Of all pairs i < j, from [positions, (a_i, s_i) of each]; as ``Clock`` defines them."""
    y, delay = x[: N * D].view(N, D), x[N * D :].view(N, 2)
    i, j = torch.triu_indices(N, N, 1)
    length = (y[i] - y[j]).norm(dim=-1)
    return length + delay[i, 0] + delay[j, 0] + delay[i, 1] - delay[j, 1]


def test_offsets_are_those_of_the_clocks_of_the_world() -> None:
    delay = 0.2 * random(1, N, 2)
    x = torch.cat((10 * random(N * D, seed=1), delay.flatten()))
    i, j = torch.triu_indices(N, N, 1)
    expected = ranges(x) - lengths(x[None, : N * D].view(1, N, D))[0, i, j]
    found = delays.offsets(delay)[0]
    torch.testing.assert_close(found[i, j], expected)
    torch.testing.assert_close(found, found.mT)


def test_information_is_that_of_automatic_differentiation() -> None:
    x = torch.cat((10 * random(N * D), 0.2 * random(2 * N, seed=1)))
    jacobian = torch.autograd.functional.jacobian(ranges, x)
    assert isinstance(jacobian, Tensor)
    weight = torch.zeros(N, N, dtype=torch.float64)
    i, j = torch.triu_indices(N, N, 1)
    weight[i, j] = random(len(i), seed=2).square()
    expected = jacobian.T @ torch.diag(weight[i, j]) @ jacobian
    found = information_matrix(x[None, : N * D].view(1, N, D), (weight + weight.T)[None], True)[0]
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


def test_positions_and_delays_are_scipys_least_squares() -> None:
    x = torch.cat((10 * random(N * D), 0.2 * random(2 * N, seed=1)))
    start = x[None, : N * D].view(1, N, D) + 0.3 * random(1, N, D, seed=2)
    i, j = torch.triu_indices(N, N, 1)
    measured = torch.zeros(1, N, N, dtype=torch.float64)
    measured[0, i, j] = ranges(x)
    measured = measured + measured.mT
    precision = torch.diag(torch.cat((torch.full((N * D,), 4.0), torch.full((2 * N,), 25.0))))
    fixed = torch.zeros(1, N, dtype=torch.bool)
    position, delay, _ = gauss_newton(
        start,
        measured,
        lambda residual: (100 * (measured > 0).double(), torch.zeros_like(residual)),
        fixed,
        start,
        precision.double()[None],
        20,
    )
    prior = torch.cat((start.flatten(), torch.zeros(2 * N, dtype=torch.float64)))
    spread = precision.diagonal().sqrt()

    def residuals(v: np.ndarray) -> np.ndarray:
        z = torch.from_numpy(v)
        return torch.cat((10 * (ranges(z) - ranges(x)), spread * (z - prior))).numpy()

    best = least_squares(residuals, prior.numpy(), xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    found = torch.cat((position.flatten(), delay.flatten()))
    np.testing.assert_allclose(found, best, atol=1e-6)


def test_variance_of_offsets() -> None:
    root = 0.1 * random(1, 2 * N, 2 * N)
    known = delays.initial(torch.zeros(1, N, D, dtype=torch.float64), CLOCK)
    known = known.replace(common=(root @ root.mT).unflatten(1, (N, 2)))
    draws = (root @ random(2 * N, 20000, seed=1)).mT.reshape(-1, N, 2)
    every = delays.offsets(draws)
    i, j = torch.triu_indices(N, N, 1)
    np.testing.assert_allclose(
        delays.offset_variance(known)[0, i, j], every.var(0)[i, j].numpy(), rtol=0.05
    )


def test_antennas_stay_and_clocks_wander() -> None:
    """After a long time s has its stationary variance again, and a its own as before."""
    known = delays.initial(torch.zeros(1, 2, D, dtype=torch.float64), CLOCK)
    known = known.replace(delay=torch.ones_like(known.delay), common=0.01 * known.common)
    factor, still = torch.ones(1, 2, dtype=torch.float64), torch.zeros(1, 2, dtype=torch.bool)
    dt = torch.full_like(factor, 1e5)
    after = delays.predict(known, factor, still, dt, CLOCK)
    own = after.common.flatten(1, 2).diagonal(dim1=1, dim2=2)[0].view(2, 2)
    np.testing.assert_allclose(own, [[0.01 * 0.2**2, 0.5 * 0.1**2]] * 2)
    np.testing.assert_allclose(after.delay, [[[1.0, 0.0]] * 2], atol=1e-12)
    once = delays.predict(known, factor, still, dt / 1e4, CLOCK)
    twice = delays.predict(known, factor, still, dt / 2e4, CLOCK)
    twice = delays.predict(twice, factor, still, dt / 2e4, CLOCK)
    torch.testing.assert_close(once.common, twice.common)


@pytest.mark.slow
@pytest.mark.parametrize(
    "overrides",
    [
        {},
        pytest.param({"clock_skew": 0.0}, marks=pytest.mark.slow),
        pytest.param({"clock_offset": 0.0}, marks=pytest.mark.slow),
    ],
)
def test_it_pays_where_clocks_are_off(overrides: dict[str, float], tools: SimpleNamespace) -> None:
    scenario = make_scenario("campus-v0", flight="s1", horizon=400, **overrides)
    errors = [
        tools.score(f"map{option}", scenario, 2, 400).rmse for option in ("", ":delays=false")
    ]
    assert errors[0] < 0.7 * errors[1]


@pytest.mark.slow
def test_delays_of_anchors_are_estimated() -> None:
    scenario = make_scenario("campus-v0", flight="s1", clock_skew=0.0)
    localizer, world = make("map", scenario), World(scenario, 2)
    observation = world.reset(torch.arange(2))
    belief = localizer.reset(observation)
    for _ in range(200):
        belief, estimate = localizer.step(belief, observation)
        world.advance(estimate.action())
        observation = world.observation()
    sensor = next(s for s in scenario.sensors if isinstance(s, Ranging))
    assert sensor.clock is not None
    truth = sensor.clock.place(row_keys(torch.arange(2)), scenario.arena.n_uavs)["offset"][:, :3]
    found = localizer.diagnostics(belief)["antenna_delay"][:, :3]
    np.testing.assert_allclose(found, truth, atol=0.1)
    assert float(truth.abs().max()) > 0.2


def test_where_clocks_agree_nothing_is_estimated() -> None:
    exact = make_scenario("campus-v0", clock_offset=0.0, clock_skew=0.0)
    for scenario in (exact, make_scenario("swarm-v0", n_uavs=20)):
        localizer, observation = make("map", scenario), World(scenario, 1).reset(0)
        belief, estimate = localizer.step(localizer.reset(observation), observation)
        assert belief.delays.common.shape[-1] == 0
        assert estimate.position.isfinite().all()
        assert "antenna_delay" not in localizer.diagnostics(belief)
