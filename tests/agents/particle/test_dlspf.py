"""The latent-space particle filter: its latent states, and Kalman's filter where they are exact."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from filterpy.kalman import KalmanFilter
from torch import Tensor

from agents import make
from agents.particle import dlspf
from agents.particle.latent import CHANNELS, WINDOW, LatentModel, unaccelerated
from agents.weights import learned
from coloc_env.observation import Observation
from coloc_env.scenario import ConstantVelocity
from coloc_env.scenarios import make_scenario


def exact() -> LatentModel:
    """Latent states that are [δp, T δv] themselves, and two idle numbers."""
    model, eye = LatentModel(), torch.eye(3)
    with torch.no_grad():
        for one in (model.encoder, model.decoder, model.transition):
            one.straight.weight.zero_()
        model.encoder.straight.weight[:6, -CHANNELS:] = torch.eye(6)
        model.decoder.straight.weight[:, :6] = unaccelerated(torch.eye(6)).flatten(-2).T
        # δp' = δp + T δv / W + T δu / 2 W,  T δv' = T δv + T δu
        step = torch.eye(6) + torch.diag(torch.full((3,), 1 / WINDOW), 3)
        model.transition.straight.weight[:6, :6] = step
        model.transition.straight.weight[:6, 8:] = torch.cat((eye / (2 * WINDOW), eye))
    return model


def test_scale_changes_nothing() -> None:
    """Clouds of millimetres and of metres are alike to every network."""
    model, g = learned(LatentModel, "dlspf").double(), torch.Generator().manual_seed(0)
    windows = torch.randn(50, WINDOW, CHANNELS, generator=g, dtype=torch.float64)
    push = torch.randn(50, 3, generator=g, dtype=torch.float64)
    for scale in (1e-3, 40.0):
        z = model.encode(windows)
        torch.testing.assert_close(model.encode(scale * windows), scale * z)
        torch.testing.assert_close(model.decode(scale * z), scale * model.decode(z))
        moved = model.advance(scale * z, scale * push)
        torch.testing.assert_close(moved, scale * model.advance(z, push))
        torch.testing.assert_close(model.newest(z), model.decode(z)[:, -1])


def test_the_shipped_model_knows_how_uavs_move() -> None:
    """Windows of constant acceleration, in closed form, now and eight latent steps later."""
    model, g = learned(LatentModel, "dlspf").double(), torch.Generator().manual_seed(1)
    place, pace, bend = torch.randn(3, 400, 3, generator=g, dtype=torch.float64).unbind(0)
    pace, bend = 0.3 * pace, 0.03 * bend  # T δv, and what it gains in a step

    def window(newest: int) -> Tensor:
        k = torch.arange(newest + 1 - WINDOW, newest + 1, dtype=torch.float64)[:, None, None]
        places = place + (pace * k + bend * k**2 / 2) / WINDOW
        return torch.cat((places, pace + bend * k), -1).transpose(0, 1)

    z = model.encode(window(0))
    for step in range(9):
        if step:
            z = model.advance(z, bend)
        apart = (model.newest(z) - window(step)[:, -1]).square().mean(0).sqrt()
        assert apart[:3].max() < 0.03, step  # of 1
        assert apart[3:].max() < 0.06, step  # of 0.3


def test_with_exact_latent_states_it_is_the_kalman_filter(
    monkeypatch: pytest.MonkeyPatch, tools: SimpleNamespace
) -> None:
    """In a linear world, within Monte Carlo error (acceleration is held over a step there)."""
    held = ConstantVelocity(0.6, held=True)
    believed: Any = replace(tools.linear.believed, process=held)
    monkeypatch.setattr(dlspf, "make_measurements", lambda _: [tools.linear.fixes])
    monkeypatch.setattr(dlspf, "learned", lambda *_: exact())
    localizer: Any = make("dlspf", believed, particles=10_000)
    n, dt, g = 2, believed.arena.dt, torch.Generator().manual_seed(0)
    prior = torch.zeros(1, n, 15)
    prior[..., 6], prior[..., 10:13], prior[..., 13] = 1.0, 1.5, 0.5
    textbook = KalmanFilter(6, 3)
    textbook.P = np.diag([1.5**2] * 3 + [0.5**2] * 3)
    textbook.F = np.eye(6) + dt * np.eye(6, k=3)
    gained = np.vstack((dt**2 / 2 * np.eye(3), dt * np.eye(3))) * held.accel_std
    textbook.Q, textbook.H = gained @ gained.T, np.eye(3, 6)
    textbook.R = tools.linear.fixes.std**2 * np.eye(3)
    belief = None
    for k in range(12):
        fix = 2 * torch.randn(3, generator=g)
        leaves = {"prior": prior, "fix": fix.expand(1, n, 3), "fix_mask": torch.ones(1, n, 1)}
        seen = Observation(leaves)
        belief = localizer.reset(seen) if belief is None else belief
        belief, estimate = localizer.step(belief, seen)
        if k:
            textbook.predict()
        textbook.update(fix.numpy())
        std = np.sqrt(textbook.P[0, 0])
        assert np.abs(estimate.position[0].numpy() - textbook.x[:3, 0]).max() < 0.3 * std
        found = estimate.covariance[0].diagonal(dim1=-2, dim2=-1).numpy()
        np.testing.assert_allclose(found, textbook.P[0, 0], rtol=0.2)


def test_what_it_cannot_carry_is_refused(tools: SimpleNamespace) -> None:
    with pytest.raises(ValueError, match="dlspf: a motion model in space that estimates velocity"):
        make("dlspf", tools.families["plane"]())


def test_the_room_is_localized(tools: SimpleNamespace) -> None:
    """As a particle filter of the state is, or nearly."""
    scenario = make_scenario("indoor-v0", n_uavs=3)
    found, plain = (tools.score(name, scenario, 2, 50) for name in ("dlspf", "pf500"))
    assert found.rmse < 1.25 * plain.rmse
