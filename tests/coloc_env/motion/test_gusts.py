"""Gusts against Dryden's spectra (MIL-F-8785C) and scipy's discrete systems."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.linalg import solve_discrete_lyapunov
from scipy.signal import welch

from coloc_env.motion import MOTIONS, Gusts
from coloc_env.motion.gusts import _discrete, model
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

STD, TIME = 0.3, 0.8
ROOM = (30.0, 20.0, 5.0)
CIRCLE = MOTIONS["circle"]


def dryden(omega, along: bool):
    """Power per rad/s on both sides of 0 (white noise of unit density has 1), in (m/s²)² s."""
    t = TIME * omega
    if along:
        return STD**2 * 2 * TIME / (1 + t**2)
    return STD**2 * TIME * (1 + 3 * t**2) / (1 + t**2) ** 2


@pytest.mark.parametrize("along", [True, False])
def test_the_model_has_drydens_spectrum_and_variance(along):
    f, g, row = model(STD, TIME, 2.0, 0.7, along)
    omega = np.geomspace(0.01, 100, 60)
    shifted = 1j * omega[:, None, None] * np.eye(len(f)) - f
    response = (row @ np.linalg.solve(shifted, np.broadcast_to(g, (len(omega), *g.shape)))).ravel()
    np.testing.assert_allclose(np.abs(response) ** 2, dryden(omega, along), rtol=1e-9)
    variance, _ = quad(lambda w: dryden(w, along) / math.pi, 0, np.inf)
    assert variance == pytest.approx(STD**2, rel=1e-8)


@pytest.mark.parametrize("along", [True, False])
def test_each_step_is_exact(along):
    """What a step's noise adds keeps the stationary covariance, whose gust has the variance asked
    for; two half steps are one."""
    onward, driven, start = (np.array(m) for m in _discrete(STD, TIME, 2.0, 0.7, along, 0.1))
    stationary = start @ start.T
    np.testing.assert_allclose(
        solve_discrete_lyapunov(onward, driven @ driven.T), stationary, atol=1e-12
    )
    assert stationary[0, 0] == pytest.approx(STD**2)
    half, added, _ = (np.array(m) for m in _discrete(STD, TIME, 2.0, 0.7, along, 0.05))
    np.testing.assert_allclose(half @ half, onward, atol=1e-12)
    noisy = half @ added @ added.T @ half.T + added @ added.T
    np.testing.assert_allclose(noisy, driven @ driven.T, atol=1e-12)


def test_what_blows_has_the_spectrum(arena, fly):
    """Welch's estimate of displacements: Dryden's spectrum through the position controller."""
    space = arena(*ROOM, n=8, dt=0.1)
    calm, blown = (fly(m, space, [0, 1], 1500) for m in (CIRCLE, Gusts(CIRCLE, STD, TIME)))
    away = (blown.position - calm.position).movedim(1, 0).flatten(1, 2).numpy()  # [K, R · N, 3]
    for axis, along in ((0, True), (1, False), (2, False)):
        hertz, power = welch(away[..., axis], fs=10.0, nperseg=256, axis=0)
        band = (hertz > 0.08) & (hertz < 1.0)
        omega = 2 * math.pi * hertz[band]
        held = np.abs(2.0**2 - omega**2 + 2j * 0.7 * 2.0 * omega) ** -2
        ratio = power.mean(1)[band] / (2 * held * dryden(omega, along))  # one-sided, per Hz
        assert abs(np.log(ratio)).max() < 0.35


@pytest.mark.parametrize("name", ["circle", "random_velocity"])
def test_the_path_is_kept_and_rows_and_windows_do_not_matter(name, arena, fly):
    space = arena(*ROOM, n=3)
    motion = Gusts(MOTIONS[name], STD, TIME)
    both = fly(motion, space, [3, 8], 60)
    alone = fly(motion, space, [8], 60, window=7)
    assert torch.equal(both.position[1:], alone.position)
    assert torch.equal(both.velocity[1:], alone.velocity)
    calm = fly(MOTIONS[name], space, [3, 8], 60)
    away = both.position - calm.position
    assert torch.equal(both.attitude, calm.attitude)
    assert 0.01 < float(away.std()) < 0.15
    assert float(away.abs().max()) < 0.5


def test_velocity_is_the_derivative_of_displacement(arena, fly):
    space = arena(*ROOM, n=2, dt=0.001)
    truth = fly(Gusts(MOTIONS["circle"], STD, TIME), space, [5], 2000)
    by_difference = (truth.position[:, 2:] - truth.position[:, :-2]) / 0.002
    assert float((by_difference - truth.velocity[:, 1:-1]).abs().max()) < 1e-3


def test_the_imu_feels_gusts():
    """Strapdown integration of a clean IMU follows the velocity that gusts bring."""
    scenario = make_scenario("indoor-v0", gust_std=0.5, accel_std=0.0, gyro_std=0.0, motion="line")
    calm = make_scenario("indoor-v0", accel_std=0.0, gyro_std=0.0, motion="line")
    felt = []
    for each in (scenario, calm):
        world = World(each)
        seen, force = world.reset(0), []
        for _ in range(100):
            world.step(torch.zeros(1, 6, 9))
            seen = world.observation()
            force.append(seen["imu"][0, :, :2])
        felt.append(torch.stack(force))
    assert 0.2 < float((felt[0] - felt[1]).std()) < 0.8


def test_gusts_do_not_go_with_commands():
    with pytest.raises(ValueError, match=r"gust_std=0\.3 is not allowed with control"):
        make_scenario("indoor-v0", gust_std=0.3, control="velocity")
    with pytest.raises(ValueError, match=r"gust_std=-1\.0 is not allowed"):
        make_scenario("indoor-v0", gust_std=-1.0)
