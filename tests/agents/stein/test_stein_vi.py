"""The visual-inertial Stein filter: its parts against closed forms and autograd; its flights."""

import math
import os
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from agents import make
from agents.models import preintegration
from agents.models.measurements import Block
from agents.models.process import InertialProcess
from agents.stein.landmarks import fit_landmarks
from agents.stein.stein_vi import SteinViFilter
from coloc_env.datasets import DataError, load
from coloc_env.motion import RecordedMotion
from coloc_env.observation import Observation
from coloc_env.scenario import Inertial, Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import Imu, RecordedImu
from coloc_env.world import World


def euroc(sequence: str = "V1_03_difficult", **overrides: Any) -> Scenario:
    """The scenario; where its data are missing the test is skipped, but not in CI."""
    try:
        load("euroc", sequence)
    except DataError as error:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(error))
    return make_scenario("replay-stein-euroc-v0", sequence=sequence, **overrides)


def localized(made: Scenario, agent: str, runs: int = 2) -> tuple[Tensor, Tensor, Any]:
    """Errors [R, K] in m, NEES [R, K], and the last belief."""
    localizer, world = make(agent, made), World(made, runs)
    observation, errors, nees = world.reset(0), [], []
    belief = localizer.reset(observation)
    for _ in range(made.horizon):
        belief, estimate = localizer.step(belief, observation)
        error = (estimate.position.double() - world.truth.position)[:, 0]
        solved = torch.linalg.solve(estimate.covariance[:, 0].double(), error)
        errors.append(error.norm(dim=-1))
        nees.append((error * solved).sum(-1))
        world.advance(estimate.action())
        observation = world.observation()
    return torch.stack(errors, 1), torch.stack(nees, 1), belief


def rms(errors: Tensor) -> float:
    return float(errors.square().mean().sqrt())


# ------------------------------------------------------------------ parts


def test_transition_against_finite_differences() -> None:
    g = torch.Generator().manual_seed(0)
    process = InertialProcess(0.1, Imu(), Inertial(0.1, 0.01))
    x = torch.randn(4, 16, generator=g).double()
    x[:, 6:10] /= x[:, 6:10].norm(dim=-1, keepdim=True)
    imu = torch.randn(4, 20, 6, generator=g).double() + 1
    dt = torch.full((4, 20), 0.02).double()

    def after(delta: Tensor) -> Tensor:
        start = process.boxplus(x, delta)
        window = preintegration.preintegrate(imu, dt, start[:, 10:], 0.1, 0.01)
        end = preintegration.predict(start[:, :10], window.increments, window.duration)
        return torch.cat((end, torch.zeros(4, 6).double()), -1)

    window = preintegration.preintegrate(imu, dt, x[:, 10:], 0.1, 0.01)
    f, noise = preintegration.transition(x[:, :10], window)
    middle, step = after(torch.zeros(4, 15).double()), 1e-5
    for column in range(15):
        delta = torch.zeros(4, 15).double()
        delta[:, column] = step
        up, down = (process.boxminus(after(s * delta), middle)[:, :9] for s in (1, -1))
        torch.testing.assert_close(f[..., column], (up - down) / (2 * step), rtol=1e-6, atol=1e-7)
    turned = process.rotation(x)
    assert turned is not None
    expected = turned @ window.covariance[:, :3, :3] @ turned.mT
    torch.testing.assert_close(noise[:, :3, :3], expected)


def test_the_mixture_against_autograd_and_its_limits() -> None:
    """g is ∇ log p of the mixture by the residual's shift; a landmark far off counts for nothing,
    and at equal odds it is worth a half."""
    g = torch.Generator().manual_seed(1)
    residual = (0.3 * torch.randn(3, 8, 3, generator=g)).double()
    residual[:, 0] = 40.0
    mask = torch.ones(3, 8, dtype=torch.bool)
    mask[:, 1] = False
    residual[:, 1] = 1e6
    jacobian = torch.randn(3, 8, 3, 6, generator=g).double()
    variance, share, volume = torch.full((3, 8), 0.04).double(), 0.2, 50.0
    delta = torch.zeros(3, 6, dtype=torch.float64, requires_grad=True)
    moved = residual - (jacobian @ delta[:, None, :, None])[..., 0]
    block = Block(residual, jacobian, variance.unsqueeze(-1), mask)
    found = fit_landmarks(block, variance, share, volume)
    shifted = fit_landmarks(replace(block, residual=moved), variance, share, volume)
    (gradient,) = torch.autograd.grad(shifted.log_density.sum(), delta)
    torch.testing.assert_close(found.gradient, gradient)
    assert (found.inliers[:, :2] < 1e-12).all()
    beta = share / (1 - share) * (2 * math.pi * 0.04) ** 1.5 / volume
    even = torch.tensor([math.sqrt(-2 * math.log(beta)) * 0.2, 0, 0]).double().expand(3, 8, 3)
    half = fit_landmarks(replace(block, residual=even), variance, share, volume).inliers
    torch.testing.assert_close(half[:, 2:], torch.full_like(half[:, 2:], 0.5))


def test_with_right_matches_it_is_the_iterated_kalman_filter() -> None:
    made = make_scenario("indoor-v0", uwb=False, n_uavs=2, imu_bias=True, believed_imu_bias=True)
    stein = make("stein_vi:outliers=1e-9:iterations=8:anneal=1e-3", made)
    kalman = make("ekf:iterations=8:cooperate=false", made)
    world = World(made, 2)
    observation = world.reset(3)
    ours, theirs = stein.reset(observation), kalman.reset(observation)
    for _ in range(15):
        ours, one = stein.step(ours, observation)
        theirs, other = kalman.step(theirs, observation)
        spread = other.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        assert ((one.position - other.position).abs() < 0.1 * spread).all()
        torch.testing.assert_close(one.covariance, other.covariance, rtol=0.05, atol=1e-7)
        world.advance(other.action())
        observation = world.observation()


def test_the_cloud_keeps_apart_and_shrinks_without_repulsion() -> None:
    made = make_scenario("indoor-v0", uwb=False, n_uavs=1)
    share = []
    for repulsion in (0.0, 1.0):
        localizer = make("stein_vi", made, particles=60, repulsion=repulsion)
        assert isinstance(localizer, SteinViFilter)
        world = World(made, 4)
        observation = world.reset(0)
        belief = localizer.reset(observation)
        for _ in range(10):
            belief, estimate = localizer.step(belief, observation)
            world.advance(estimate.action())
            observation = world.observation()
        apart = localizer.process.boxminus(belief.x, belief.state.unsqueeze(2))
        cloud = (apart.mT @ apart / 60).diagonal(dim1=-2, dim2=-1)[..., :3]
        share.append((cloud / belief.covariance.diagonal(dim1=-2, dim2=-1)[..., :3]).mean())
    assert share[0] < 0.15
    assert 0.2 < share[1] < 1.5


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("particles=0", "particles='0' is not allowed: a whole number ≥ 1"),
        ("iterations=0", "iterations='0' is not allowed: a whole number ≥ 1"),
        ("outliers=0", "outliers='0' is not allowed: a number > 0 and < 1"),
        ("anneal=0", "anneal='0' is not allowed: a number > 0 and ≤ 1"),
        ("pace=2", "pace='2' is not allowed: a number > 0 and ≤ 1"),
        ("repulsion=-1", "repulsion='-1' is not allowed: a number ≥ 0"),
    ],
)
def test_refused_options(option: str, words: str) -> None:
    with pytest.raises(ValueError, match=f"^stein_vi: {words}"):
        make(f"stein_vi:{option}", make_scenario("indoor-v0"))


@pytest.mark.parametrize("overrides", [{"landmarks": 0}, {"imu": False}])
def test_refused_teams(overrides: dict[str, Any]) -> None:
    believed = make_scenario("indoor-v0", **overrides).believed
    with pytest.raises(ValueError, match=r"a team with an IMU, landmarks and inertial motion"):
        SteinViFilter(believed)
    with pytest.raises(ValueError, match=r"^stein_vi: what the team measures with Ranging"):
        make("stein_vi", make_scenario("indoor-v0", **overrides))


# ------------------------------------------------------------------ EuRoC


def test_the_imu_is_told_whole() -> None:
    """The samples of a step, pre-integrated, are its mean: velocity and turn, to float32."""
    made = euroc(span=(20.0, 24.0))
    sensor = made.sensors[0]
    assert isinstance(sensor, RecordedImu)
    held = sensor.series["imu_held"].values[1:, 0].double()
    torch.testing.assert_close(held.sum(-1), torch.full_like(held[:, 0], 0.1), rtol=0, atol=1e-6)
    samples = sensor.series["imu_samples"].values[1:, 0].double().unflatten(-1, (-1, 6))
    window = preintegration.preintegrate(samples, held, torch.zeros(len(held), 6).double(), 0, 0)
    mean = sensor.series["imu"].values[1:, 0].double() * 0.1
    gained = window.increments[:, 3:6]
    assert (gained - mean[:, :3]).norm(dim=-1).max() < 5e-3
    angle = 2 * window.increments[:, 7:]
    assert (angle - mean[:, 3:]).norm(dim=-1).max() < 1e-3


def test_a_second_of_samples_is_more_than_their_mean() -> None:
    """From the true state, without the bias left: 3 cm off after a second (median), by the mean
    force and rate alone 17 cm; after 0.1 s both 1 mm."""
    made = euroc(dt=1.0)
    motion, sensor = made.motion, made.sensors[0]
    assert isinstance(motion, RecordedMotion)
    assert isinstance(sensor, RecordedImu)
    x = torch.cat([t.values[:, 0] for t in (motion.position, motion.velocity, motion.attitude)], -1)
    held = sensor.series["imu_held"].values[1:, 0].double()
    samples = sensor.series["imu_samples"].values[1:, 0].double().unflatten(-1, (-1, 6))
    mean = sensor.series["imu"].values[1:, :1, :].double()
    left = torch.tensor([0.0301, -0.0424, 0.0036, -0.00005, -0.00074, -0.00021]).double()
    off = []
    for imu, lasting in ((samples, held), (mean, torch.ones_like(held[:, :1]))):
        window = preintegration.preintegrate(imu, lasting, left.expand(len(held), 6), 0, 0)
        after = preintegration.predict(x[:-1], window.increments, window.duration)
        off.append((after[:, :3] - x[1:, :3]).norm(dim=-1))
    assert off[0].median() < 0.04
    assert off[0].quantile(0.9) < 0.08
    assert off[1].median() > 3 * off[0].median()


@pytest.mark.slow
def test_false_matches_hurt_no_more_than_without() -> None:
    """Against the plain EKF, which believes them, and the gated one, which is as good."""
    made = euroc(span=(0.0, 15.0), false_matches=0.1)
    ours, nees, belief = localized(made, "stein_vi")
    plain, _, _ = localized(made, "ekf")
    gated, _, _ = localized(made, "ekf:robust=gate")
    dead, _, _ = localized(made, "dead_reckoning")
    assert rms(ours[:, 20:]) < 0.05
    assert rms(ours[:, 20:]) < 1.15 * rms(gated[:, 20:])
    assert rms(plain[:, 20:]) > 2 * rms(ours[:, 20:])
    assert rms(dead[:, -10:]) > 5
    assert 1.5 < nees[:, 20:].mean() < 5.5
    assert 0.8 < belief.inliers.mean() <= 1


@pytest.mark.slow
def test_half_of_the_matches_wrong() -> None:
    made = euroc(span=(0.0, 10.0), false_matches=0.5, prior_std=0.5)
    ours, _, belief = localized(made, "stein_vi:outliers=0.5")
    assert rms(ours[:, 20:]) < 0.08
    assert belief.inliers.mean() < 0.75


def test_without_samples_the_mean_serves() -> None:
    """Where a scenario tells no more than the step's mean, as simulated ones do."""
    made = euroc(span=(0.0, 3.0), false_matches=0.0)
    localizer, world = make("stein_vi", made), World(made, 2)
    observation = world.reset(1)
    belief = localizer.reset(observation)
    belief, _ = localizer.step(belief, observation)
    world.advance(torch.zeros(2, 1, 9))
    observation = world.observation()
    whole, one = localizer.step(belief, observation)
    mean = {k: v for k, v in observation.leaves.items() if not k.startswith("imu_")}
    _, other = localizer.step(belief, Observation(mean))
    assert (one.position - other.position).abs().max() < 2e-3
    assert not torch.equal(one.position, other.position)
    assert whole.x.shape == (2, 1, 20, 16)


def test_refused_landmarks() -> None:
    euroc(span=(0.0, 1.0))
    with pytest.raises(ValueError, match=r"^replay-stein-euroc-v0: landmarks=0 is not allowed"):
        make_scenario("replay-stein-euroc-v0", landmarks=0)
