"""The window, its fading and the weight of motion as the paper has them."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from agents import make
from agents.swarm import adaptive
from coloc_env.scenarios import make_scenario
from coloc_env.world import World


@pytest.mark.parametrize(
    ("reach", "a_max", "dt", "steps"),
    [(5000.0, 33.0, 1.0, 10), (1230.0, 33.0, 1.0, 9), (400.0, 8.0, 1.0, 10), (50.0, 4.0, 1.0, 5),
     (50.0, 4.0, 0.5, 10)],
)  # fmt: skip
def test_the_window_is_the_time_to_leave_the_reach(
    reach: float, a_max: float, dt: float, steps: int
) -> None:
    """From a standstill, ½ a t² = R at the end of the T-th step or before; at most T_max = 10."""
    found = adaptive.window_length(reach, a_max, dt, 10)
    assert found == steps
    if found < 10:
        assert 0.5 * a_max * (found * dt) ** 2 >= reach > 0.5 * a_max * ((found - 1) * dt) ** 2


def test_old_ranges_fade_as_dead_reckoning_loses_them() -> None:
    """A step's factor of w(τ) is σ²/(σ² + 2 q²), whatever the length of the step."""
    noise = torch.tensor([[0.5, 1.5, 90.0], [0.0, 0.0, 90.0]], dtype=torch.float64)
    free = torch.tensor([[True, True, False]] * 2)
    dt = torch.full((2, 3), 0.5, dtype=torch.float64)
    rate = adaptive.decay(noise, free, 2.0, dt)
    assert torch.exp(-rate[:, 0] * 0.5).tolist() == pytest.approx([4 / (4 + 2), 1.0])


def test_lambda_s_is_above_the_spectral_radius_of_regular_graphs() -> None:
    """A ring's and a complete graph's Laplacian by numpy; the estimate is by the average degree."""
    n = 12
    ring = torch.zeros(n, n, dtype=torch.bool)
    index = torch.arange(n)
    ring[index, (index + 1) % n] = ring[(index + 1) % n, index] = True
    for mask in (ring, ~torch.eye(n, dtype=torch.bool)):
        laplacian = np.diag(mask.sum(-1).double().numpy()) - mask.double().numpy()
        radius = float(np.linalg.eigvalsh(laplacian)[-1])
        found = float(adaptive.smoothing(mask.unsqueeze(0), 10.0)) * 10.0**2
        assert radius < found <= 2.5 * radius


def last_error(agent: str, **overrides: Any) -> float:
    """RMSE (m) in the last of ten steps."""
    few = {"n_uavs": 20, "anchor_share": 0.4, "ins_bias": 0.0, "comm_radius": 9000.0, "nlos": 0.0}
    scenario = make_scenario("swarm-v0", **few | overrides)
    localizer: Any = make(agent, scenario)
    world = World(scenario, 1)
    observation = world.reset(2)
    belief = localizer.reset(observation)
    for _ in range(10):
        belief, estimate = localizer.step(belief, observation)
        error = (estimate.position - world.truth.position)[:, 8:]
        world.advance(estimate.action())
        observation = world.observation()
    return math.sqrt(float(error.square().sum(-1).mean()))


def test_adaptive_settings_change_what_is_weighted() -> None:
    """λ_s above the spectral radius holds on to dead reckoning: it converges, but slowly."""
    usual, slow, windowed = (
        last_error(f"dwmds_st:confidence=none{x}")
        for x in ("", ":adaptive=true", ":adaptive=true:window=5")
    )
    assert usual < windowed < slow < 80
