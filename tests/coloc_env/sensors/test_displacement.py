"""Displacements and ranges whose noise grows with distance: samples, models, information."""

import math

import pytest
import torch

from agents.kalman.ekf_joint import JointEkf
from agents.models.measurements import make_measurements, no_neighbours
from agents.models.process import DisplacementProcess, make_process
from coloc_env.bounds import posterior_bound
from coloc_env.bounds.mixture import distance_information
from coloc_env.motion import Arena, Roam
from coloc_env.network import Network
from coloc_env.scenario import DisplacementDriven, Prior, Scenario
from coloc_env.sensors import AnchorRanging, Displacement, RangeNoise, Ranging
from coloc_env.world import World

ANCHORS = ((0.0, 0.0), (100.0, 0.0), (0.0, 100.0))
NOISE = RangeNoise(0.1, per_metre=0.05)


def team(n: int = 50, speed: float = 2.0, horizon: int = 40) -> Scenario:
    sensors = (Displacement(0.1, 0.3), Ranging(NOISE), AnchorRanging(ANCHORS, NOISE))
    return Scenario(
        name="displaced",
        arena=Arena(2, n, 1.0, (0.0, 0.0), (100.0, 100.0)),
        horizon=horizon,
        motion=Roam(speed),
        sensors=sensors,
        network=Network(max_neighbours=n),
        prior=Prior(0.5),
        process=DisplacementDriven(),
        believed_sensors=sensors,
    )


def test_variance_grows_with_the_distance_and_is_what_the_model_says() -> None:
    world = World(team())
    world.reset(1)
    assert not world.observation()["displacement"].any()
    errors, moments = [], []
    for _ in range(40):
        before = world.truth.position
        world.advance(torch.zeros(1, 50, 6))
        moved = world.truth.position - before
        z = world.observation()["displacement"].double()
        full = (moved.norm(dim=-1) - 2.0).abs() < 1e-9
        errors.append((z - moved)[full])
        moments.append((z * z).sum(-1)[full])
    variance = torch.cat(errors).var()
    assert variance == pytest.approx(0.01 + 0.09 * 2.0, rel=0.05)
    sensor = Displacement(0.1, 0.3)
    z = torch.tensor([torch.cat(moments).mean().sqrt(), 0.0])
    assert sensor.distance(z.unsqueeze(0))[0] == pytest.approx(2.0, abs=0.05)
    process = make_process(team().believed)
    assert isinstance(process, DisplacementProcess)


def test_blind_uavs_measure_nothing_and_walk() -> None:
    sensor = Displacement(0.1, 0.3, blind=2, walk=1.5)
    variance = sensor.variance(torch.ones(4))
    assert variance.tolist() == pytest.approx([0.1, 0.1, 2.25, 2.25])


def test_range_noise_grows_with_distance() -> None:
    keys = torch.arange(40_000)
    distance = torch.full((40_000,), 30.0)
    ranges, _ = NOISE.sample(distance, keys, "test")
    assert (ranges - 30.0).std() == pytest.approx(0.1 + 0.05 * 30, rel=0.02)


def test_range_jacobian_and_variance_by_finite_differences() -> None:
    scenario = team(4)
    world = World(scenario)
    observation, process = world.reset(2), make_process(scenario.believed)
    x = torch.cat((world.truth.position, world.truth.velocity), -1)
    model = make_measurements(scenario.believed)[1]
    neighbours = no_neighbours(x[..., :2])
    block, step = model.linearize(process, x, observation, neighbours), 1e-5
    apart = x[..., None, :2] - torch.tensor(ANCHORS, dtype=torch.float64)
    expected = (0.1 + 0.05 * apart.norm(dim=-1)) ** 2
    torch.testing.assert_close(block.variance[..., 0], expected)
    for axis in range(2):
        delta = torch.zeros(2, dtype=torch.float64)
        delta[axis] = step
        ends = [
            model.linearize(process, process.boxplus(x, s * delta), observation, neighbours)
            for s in (1, -1)
        ]
        slope = (ends[1].residual - ends[0].residual) / (2 * step)
        torch.testing.assert_close(block.jacobian[..., axis], slope, rtol=0, atol=1e-8)


def test_information_is_that_of_the_log_likelihood() -> None:
    """E[(∂ log p / ∂d)²] over samples of N(d, (σ₀ + c d)²), by automatic differentiation."""
    g = torch.Generator().manual_seed(0)
    d = torch.full((400_000,), 4.0, dtype=torch.float64, requires_grad=True)
    noise = RangeNoise(0.1, per_metre=0.2)
    std = noise.std + noise.per_metre * d
    z = (d + std * torch.randn(d.shape, generator=g, dtype=torch.float64)).detach()
    logp = -0.5 * ((z - d) / std) ** 2 - std.log()
    (slope,) = torch.autograd.grad(logp.sum(), d)
    expected = float((slope**2).mean())
    assert float(distance_information(noise, d[:1].detach())) == pytest.approx(expected, rel=0.01)
    with pytest.raises(NotImplementedError, match="must be Gaussian"):
        distance_information(RangeNoise(nlos=0.1, per_metre=0.1), d[:1])


def test_the_filter_is_consistent_and_near_its_bound() -> None:
    scenario = team(6)
    localizer, world = JointEkf(scenario.believed), World(scenario, 40)
    observation = world.reset(0)
    belief, squares, nees = localizer.reset(observation), [], []
    for _ in range(40):
        belief, estimate = localizer.step(belief, observation)
        offset = estimate.position - world.truth.position
        inverse = torch.linalg.inv(estimate.covariance)
        nees.append((offset.unsqueeze(-2) @ inverse @ offset.unsqueeze(-1)).mean())
        squares.append((offset**2).sum(-1))
        world.advance(estimate.action())
        observation = world.observation()
    rmse = torch.stack(squares[10:]).mean().sqrt()
    bound = math.sqrt(float((posterior_bound(scenario, 5, steps=40).position[10:] ** 2).mean()))
    assert 0.95 * bound < rmse < 1.35 * bound
    assert 1.8 < torch.stack(nees[10:]).mean() < 3.5
