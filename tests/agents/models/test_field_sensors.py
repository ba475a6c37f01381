"""Filters with the sensors that robots carry: likelihoods as scipy has them, honest covariances."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from agents import make
from agents.models.measurements import Neighbours, make_measurements
from agents.models.process import make_process
from agents.particle.likelihood import log_likelihood
from agents.robust import Trust
from coloc_env.bounds import posterior_bound
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import Tdoa
from coloc_env.world import World

RANGED: dict[str, Any] = {"landmarks": 0, "uwb": False}
KNOWN = 0.2  # m, of neighbours' positions
Predict = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def tdoa(p: np.ndarray, v: np.ndarray, q: np.ndarray) -> np.ndarray:
    anchors = np.array(make_scenario("indoor-v0", tdoa_anchors=4).sensors[-1].anchors)
    tags = p + Rotation.from_quat(np.roll(q, -1)).apply([(0.3, 0, 0), (-0.3, 0, 0)])
    far = np.linalg.norm(tags[:, None] - anchors, axis=-1)
    return (np.roll(far, -1, 1) - far).ravel()


def fix(p: np.ndarray, v: np.ndarray, q: np.ndarray) -> np.ndarray:
    return p


def flow(p: np.ndarray, v: np.ndarray, q: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(np.roll(q, -1)).inv().apply(v)[:2]


def compass(p: np.ndarray, v: np.ndarray, q: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(np.roll(q, -1)).as_euler("ZYX")[:1]


def strengths(p: np.ndarray, v: np.ndarray, q: np.ndarray) -> np.ndarray:
    points = np.array(make_scenario("indoor-v0", rssi=True).sensors[-1].points)
    return -40 - 22 * np.log10(np.linalg.norm(p - points, axis=-1))


LIKELIHOODS: dict[str, tuple[dict[str, Any], str, Predict, Any]] = {
    "tdoa": ({"tdoa_anchors": 4, "tags": 2, "tag_arm": 0.3}, "tdoa", tdoa, 0.15),
    "gnss": ({"gnss": True}, "position_fix", fix, np.array((1.0, 1.0, 2.0))),
    "flow": ({"flow": True, "flow_std": 0.3}, "flow", flow, 0.3),
    "compass": ({"compass": True}, "compass", compass, 0.1),
    "signal strength": ({"rssi": True, "rssi_std": 0.3}, "rssi", strengths, 0.3),
}


def clouds(scenario: Scenario) -> tuple[Any, ...]:
    """Particles [1, N, M, S] about the truth, observation, process, models."""
    world = World(scenario)
    seen = world.reset(3)
    process = make_process(scenario.believed)
    t = world.truth
    x = torch.cat((t.position, t.velocity, t.attitude), -1)
    g = torch.Generator().manual_seed(0)
    e = 0.1 * torch.randn(*x.shape[:2], 7, 9, generator=g, dtype=torch.float64)
    particles = process.boxplus(x.unsqueeze(2).expand(-1, -1, 7, -1), e)
    return particles, seen, process, make_measurements(scenario.believed), t


@pytest.mark.parametrize("name", LIKELIHOODS)
def test_log_likelihoods_are_scipys(name: str) -> None:
    """Of each particle, up to what all of a UAV's have in common."""
    overrides, leaf, predict, std = LIKELIHOODS[name]
    scenario = make_scenario("indoor-v0", **RANGED, **overrides)
    x, seen, process, models, truth = clouds(scenario)
    none = truth.position.unsqueeze(2)[:, :, :0]
    around = Neighbours(none, none, none[..., 0] > 0)
    centre = x[:, :, 0]
    found = log_likelihood(models, process, x, centre, seen, around, [Trust()])[0].numpy()
    for i in range(x.shape[1]):
        z = seen[leaf][0, i].double().numpy()
        wanted = [
            norm.logpdf(z, predict(*np.split(one, (3, 6))), std).sum() for one in x[0, i].numpy()
        ]
        wanted = np.array(wanted)
        np.testing.assert_allclose(found[i] - found[i, 0], wanted - wanted[0], rtol=0, atol=2e-3)
        assert np.ptp(wanted) > 0.05


def test_log_likelihood_of_angles_is_scipys() -> None:
    """A neighbour's uncertainty counts as noise, at each particle; without any it is the normal
    density of both angles."""
    scenario = make_scenario("indoor-v0", **RANGED, angles=True)
    x, seen, process, models, truth = clouds(scenario)
    place = truth.position.unsqueeze(1).expand(-1, x.shape[1], -1, -1)
    known = torch.ones(place.shape[:3], dtype=torch.bool)
    exact = Neighbours(place, torch.zeros_like(place), known)
    found = log_likelihood(models, process, x, x[:, :, 0], seen, exact, [Trust()])[0].numpy()
    for i in range(x.shape[1]):
        wanted = []
        for one in x[0, i].numpy():
            turn = Rotation.from_quat(np.roll(one[6:], -1)).inv()
            total = 0.0
            for j in range(x.shape[1]):
                if seen["arrival_angle_mask"][0, i, j]:
                    v = turn.apply(place[0, i, j].numpy() - one[:3])
                    z = seen["arrival_angles"][0, i, 2 * j : 2 * j + 2].double().numpy()
                    off = z - (np.arctan2(v[1], v[0]), np.arcsin(v[2] / np.linalg.norm(v)))
                    off[0] = (off[0] + np.pi) % (2 * np.pi) - np.pi
                    total += norm.logpdf(off, 0, 0.05).sum()
            wanted.append(total)
        wanted = np.array(wanted)
        np.testing.assert_allclose(found[i] - found[i, 0], wanted - wanted[0], rtol=1e-4, atol=5e-3)


CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "tdoa": ("ekf", {"tdoa_anchors": 8}),
    "tdoa, tags": ("ekf", {"tdoa_anchors": 8, "tags": 2, "tag_arm": 0.3}),
    "anchors, tags": ("ekf", {"anchors": 8, "tags": 2, "tag_arm": 0.3}),
    "gnss": ("ekf", {"gnss": True, "gnss_outage": 0.3, "gnss_outage_time": 1.0}),
    "flow": ("ekf", {"gnss": True, "flow": True}),
    "barometer": ("ekf", {"tdoa_anchors": 8, "barometer": True}),
    "angles": ("ekf_joint", {"anchors": 8, "angles": True}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_covariances_are_honest_and_errors_near_the_bound(name: str) -> None:
    """NEES of the position about 3, its RMSE by the bound: over 20 worlds of 80 steps."""
    agent, overrides = CASES[name]
    scenario = make_scenario("indoor-v0", **RANGED, n_uavs=3, **overrides)
    rows, steps = 20, 80
    world, localizer = World(scenario, rows), make(agent, scenario)
    seen = world.reset(torch.arange(rows))
    belief, squared, nees = localizer.reset(seen), [], []
    for _ in range(steps):
        belief, estimate = localizer.step(belief, seen)
        error = (estimate.position - world.truth.position).double()
        whitened = torch.linalg.solve(estimate.covariance.double(), error)
        squared.append(error.square().sum(-1))
        nees.append((error * whitened).sum(-1))
        world.advance(estimate.action())
        seen = world.observation()
    bound = posterior_bound(scenario, rows, steps=steps).rmse
    rmse = float(torch.stack(squared).mean().sqrt())
    assert 0.85 * bound < rmse < 1.35 * bound
    assert 2.3 < float(torch.stack(nees).mean()) < 3.9


@pytest.mark.slow
def test_a_drift_that_is_estimated_beats_one_that_is_considered() -> None:
    """A barometer must not make time differences worse."""
    errors = []
    for barometer in (False, True):
        scenario = make_scenario(
            "indoor-v0", **RANGED, n_uavs=3, tdoa_anchors=8, barometer=barometer
        )
        world, localizer = World(scenario, 20), make("ekf", scenario)
        seen = world.reset(torch.arange(20))
        belief, squared = localizer.reset(seen), []
        for _ in range(60):
            belief, estimate = localizer.step(belief, seen)
            squared.append((estimate.position - world.truth.position).square().sum(-1))
            world.advance(estimate.action())
            seen = world.observation()
        errors.append(float(torch.stack(squared)[20:].mean().sqrt()))
    assert errors[1] < errors[0]


def test_huber_withstands_time_differences_with_a_tail() -> None:
    """Which the team does not believe in."""
    scenario = make_scenario(
        "indoor-v0", **RANGED, n_uavs=2, tdoa_anchors=8, tdoa_tail=0.2, tdoa_tail_std=2.0
    )
    (believed,) = (s for s in scenario.believed.sensors if isinstance(s, Tdoa))
    assert believed.tail == 0
    errors = {}
    for agent in ("ekf", "ekf:robust=huber"):
        world, localizer = World(scenario, 16), make(agent, scenario)
        seen = world.reset(torch.arange(16))
        belief, squared = localizer.reset(seen), []
        for _ in range(20):
            belief, estimate = localizer.step(belief, seen)
            squared.append((estimate.position - world.truth.position).square().sum(-1))
            world.advance(estimate.action())
            seen = world.observation()
        errors[agent] = float(torch.stack(squared)[8:].mean().sqrt())
    assert errors["ekf:robust=huber"] < 0.5 * errors["ekf"]


EVERYTHING: dict[str, Any] = {
    "n_uavs": 3,
    "landmarks": 5,
    "anchors": 4,
    "tags": 2,
    "tag_arm": 0.3,
    "tdoa_anchors": 4,
    "angles": True,
    "gnss": True,
    "gnss_outage": 0.3,
    "flow": True,
    "barometer": True,
}
QUICK = (
    *("ekf", "ekf:fusion=ci", "ekf:fusion=pairwise", "ekf:robust=huber+gate", "ekf_joint"),
    *("ekf:fusion=ci:second_order=true", "ekf_joint:second_order=true", "emvf", "pf500"),
)
SLOW = (
    *("ekf:fusion=exchange", "ekf_trust", "dfgo", "dfgo_central", "apf", "pfnn", "pf_trust"),
    *("pf500:proposal=ekf", "pf500:robust=huber", "hpff", "nnhpff"),
)


@pytest.mark.parametrize(
    "agent", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)]
)
def test_everything_at_once_is_served(agent: str) -> None:
    """By every filter that serves whatever has a model: finite, and near the truth."""
    scenario = make_scenario("indoor-v0", **EVERYTHING)
    world, localizer = World(scenario, 2), make(agent, scenario)
    assert not localizer.ignores(scenario.believed)
    seen = world.reset(torch.arange(2))
    belief = localizer.reset(seen)
    for _ in range(6):
        belief, estimate = localizer.step(belief, seen)
        error = estimate.position - world.truth.position
        world.advance(estimate.action())
        seen = world.observation()
    assert bool((torch.linalg.eigvalsh(estimate.covariance.double()) > 0).all())
    assert float(error.norm(dim=-1).max()) < 2.0
