"""Biases that are considered: variances that are the true ones, and gains that are not touched."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from agents import make
from agents.kalman.filter import GaussianFilter
from agents.models.biases import Biases, kept_share, reported
from agents.models.measurements import Heights
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import Height
from coloc_env.world import World

BIAS, NOISE, Q = 0.7, 0.4, 0.05


def gains(steps: int) -> list[float]:
    """Of a scalar filter of a random walk that is measured at every step."""
    p, found = 2.0, []
    for _ in range(steps):
        p += Q
        k = p / (p + NOISE**2)
        p *= 1 - k
        found.append(k)
    return found


def considered(steps: int, time: float) -> float:
    """The reported variance of that filter after so many steps of 1 s."""
    model = Heights(Height(NOISE, bias_std=BIAS, bias_time=time))
    biases, one = Biases([model], 1.0), torch.ones(1, 1, 1, 1, dtype=torch.float64)
    seen = Observation({"height_mask": torch.ones(1, 1, 1)})
    p, about = 2.0 * one, biases.initial(seen, one)
    for k in gains(steps):
        about = biases.predict(about, one, seen)
        before, p = p + Q, (1 - k) * (p + Q)
        about = biases.update(about, kept_share(before, p), k * one, seen)
    return float(reported(p, about))


@pytest.mark.parametrize("steps", [1, 3, 40])
def test_of_a_constant_bias_it_is_the_true_variance(steps: int) -> None:
    """e ← (1 − K)(e + w) − K (b + v): the bias enters as c b, c ← (1 − K) c − K."""
    p, c = 2.0, 0.0
    for k in gains(steps):
        p = (1 - k) ** 2 * (p + Q) + k**2 * NOISE**2
        c = (1 - k) * c - k
    assert considered(steps, 1e9) == pytest.approx(p + c**2 * BIAS**2, rel=1e-6)


@pytest.mark.parametrize("time", [3.0, 30.0])
def test_of_a_bias_that_changes_it_is_the_mean_square_error(time: float) -> None:
    """Of 200 000 filters with biases of their own."""
    rng, runs, steps = np.random.default_rng(0), 200_000, 30
    e, b = 2.0**0.5 * rng.standard_normal(runs), BIAS * rng.standard_normal(runs)
    phi = math.exp(-1 / time)
    for k in gains(steps):
        b = phi * b + math.sqrt(1 - phi**2) * BIAS * rng.standard_normal(runs)
        e = (1 - k) * (e + Q**0.5 * rng.standard_normal(runs))
        e -= k * (b + NOISE * rng.standard_normal(runs))
    assert considered(steps, time) == pytest.approx(float((e**2).mean()), rel=0.015)


@settings(max_examples=20, deadline=None)
@given(std=st.floats(0.0, 5.0), time=st.floats(0.1, 1e4), steps=st.integers(1, 20))
def test_a_bias_never_makes_anything_surer(std: float, time: float, steps: int) -> None:
    assert considered(steps, time) >= 0.99999 * gains(steps)[-1] * NOISE**2


def anchored(**overrides: float) -> Scenario:
    return make_scenario("indoor-v0", anchors=8, landmarks=0, imu=False, **overrides)


@pytest.mark.parametrize("name", ["ekf", "ekf_joint", "pf500", "map", "ekf:fusion=pairwise"])
def test_gains_stay_and_only_the_covariance_grows(name: str, tools: SimpleNamespace) -> None:
    """Of the same observations; biased range by range, alone and in the team."""
    plain, biased = anchored(), anchored(range_bias_std=0.2)
    run = tools.play(make(name, plain), biased, [0, 1], 6)
    other = tools.replay(make(name, biased), run.observations)
    torch.testing.assert_close(other.position, run.position, rtol=0, atol=1e-9)
    more = other.estimates[-1].covariance - run.estimates[-1].covariance
    assert torch.linalg.eigvalsh(more.double()).min() > -1e-9
    assert more.diagonal(dim1=-2, dim2=-1).min() > 1e-4


@pytest.mark.parametrize("name", ["ekf", "ekf_joint", "pf500", "map"])
def test_without_a_believed_bias_none_is_considered(name: str, tools: SimpleNamespace) -> None:
    run = tools.play(make(name, anchored()), anchored(), [0], 2)
    found = run.beliefs[-1]
    assert found.considered.shape[-1] == 0


def test_a_team_that_measures_nothing_of_each_other_considers_alike(tools: SimpleNamespace) -> None:
    scenario = anchored(range_bias_std=0.3, prior_std=0.2)
    one, joint = (
        tools.play(make(f"{name}:cooperate=false", scenario), scenario, [0], 8)
        for name in ("ekf", "ekf_joint")
    )
    torch.testing.assert_close(
        joint.estimates[-1].covariance, one.estimates[-1].covariance, rtol=1e-8, atol=1e-12
    )


def test_a_pairs_bias_is_one_for_both_ends() -> None:
    """Two UAVs far apart, one fixed by its prior: the range's bias is the other's error."""
    far, spread = 1000.0, 2.0
    added = []
    for std in (0.0, 0.5):
        scenario = make_scenario("indoor-v0", n_uavs=2, imu=False, landmarks=0, range_bias_std=std)
        localizer, seen = make("ekf_joint", scenario), World(scenario).reset(0)
        prior, both = torch.zeros_like(seen["prior"]), 1 - torch.eye(2).unsqueeze(0)
        prior[0, 1, 0], prior[..., 6], prior[..., -2:] = far, 1.0, 0.1
        prior[0, 0, -5:-2], prior[0, 1, -5:-2] = 1e-4, spread
        leaves = {"prior": prior, "ranges": far * both, "range_mask": both, "links": both}
        known = Observation({**seen.leaves, **leaves})
        _, estimate = localizer.step(localizer.reset(known), known)
        added.append(float(estimate.covariance[0, 1, 0, 0]))
    gain = spread**2 / (spread**2 + 0.2**2)
    assert added[0] == pytest.approx(gain * 0.2**2, rel=0.03)
    assert added[1] - added[0] == pytest.approx(gain**2 * 0.5**2, rel=0.02)


def test_considered_the_team_is_honest(tools: SimpleNamespace) -> None:
    """Ranges with biases that last, which the filter's own covariance knows nothing of."""
    scenario = anchored(range_bias_std=0.4)
    unaware = replace(scenario, believed_sensors=anchored().believed_sensors)
    for name in ("ekf:cooperate=false", "ekf_joint"):
        honest, proud = (tools.score(name, one, 6, 150) for one in (scenario, unaware))
        assert honest.rmse == pytest.approx(proud.rmse, rel=1e-6)
        assert 2.0 < honest.nees.mean() < 4.0
        assert proud.nees.mean() > 2 * honest.nees.mean()


def test_a_restart_forgets_what_biases_did(tools: SimpleNamespace) -> None:
    scenario = anchored(range_bias_std=0.4)
    localizer = make("ekf", scenario)
    assert isinstance(localizer, GaussianFilter)
    belief = tools.play(localizer, scenario, [0], 3).beliefs[-1]
    rows = torch.tensor([[True, False, False, False, False, False]])
    after = localizer.restart_from(belief, rows, belief.state, belief.covariance)
    assert not after.considered[0, 0].any()
    assert after.considered[0, 1].any()
