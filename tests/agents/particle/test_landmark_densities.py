"""Likelihoods of landmark vectors, summed one by one with scipy's densities."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal, multivariate_t

from agents import make
from agents.association.clutter import CLUTTER, reach_volume
from agents.models.measurements import LandmarkVectors, no_neighbours
from agents.particle.likelihood import log_likelihood
from agents.robust import Trust
from agents.robust.heavy_tails import LogDensity, student_log_density
from coloc_env.geometry import rotation_matrix
from coloc_env.observation import Observation
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import UnlabelledLandmarks
from coloc_env.world import World

NORMAL = multivariate_normal(np.zeros(3), 0.15**2 * np.eye(3)).logpdf
STUDENT = multivariate_t(np.zeros(3), 0.15**2 * np.eye(3), df=4).logpdf


def cloud(association: str) -> tuple[Any, Observation, torch.Tensor, torch.Tensor]:
    """A filter, what one world shows it, and 5 particles near the truth, with their centre."""
    scenario = make_scenario("indoor-v0", association=association, landmarks=7, n_uavs=2, uwb=False)
    world = World(scenario)
    seen, g = world.reset(0), torch.Generator().manual_seed(0)
    truth = world.truth
    state = torch.cat((truth.position, truth.velocity, truth.attitude), -1).float()
    localizer: Any = make("pf500:tempering=false", scenario)
    delta = 0.1 * torch.randn(1, 2, 5, 9, generator=g)
    particles = localizer.process.boxplus(state.unsqueeze(2).expand(-1, -1, 5, -1), delta)
    return localizer, seen, particles, state


def evaluated(
    parts: tuple[Any, Observation, torch.Tensor, torch.Tensor], tails: LogDensity | None
) -> np.ndarray:
    """Differences between particles of UAV 0's log-likelihood."""
    localizer, seen, particles, centre = parts
    models = [m for m in localizer.models if isinstance(m, LandmarkVectors)]
    nobody = no_neighbours(centre[..., :3])
    at = (models, localizer.process, particles, centre, seen, nobody, [Trust()])
    found = log_likelihood(*at, tails, localizer.volume)[0, 0].numpy()
    return found - found[0]


def residuals(
    parts: tuple[Any, Observation, torch.Tensor, torch.Tensor], leaf: str, mask: str
) -> np.ndarray:
    """z_m − Rᵀ(L_l − p) [5, m, L, 3] of what UAV 0 measured."""
    _, seen, particles, _ = parts
    z = seen[leaf][0, 0].view(-1, 3)[seen[mask][0, 0] > 0].double()
    points, x = seen["landmark_map"][0, 0].view(-1, 3).double(), particles[0, 0].double()
    expected = (points - x[:, None, :3]) @ rotation_matrix(x[:, 6:10])
    return (z[None, :, None] - expected[:, None]).numpy()


@pytest.mark.parametrize(("tails", "log_p"), [(None, NORMAL), (student_log_density, STUDENT)])
def test_any_landmark_of_the_map_or_clutter(tails: Any, log_p: Any) -> None:
    parts = cloud("unknown")
    sensor = parts[0].believed.sensor(UnlabelledLandmarks)
    each = np.exp(log_p(residuals(parts, "unlabelled_landmarks", "unlabelled_landmark_mask")))
    clutter = CLUTTER / reach_volume(sensor, 3)
    expected = np.log(clutter + (1 - CLUTTER) * each.mean(-1)).sum(-1)
    np.testing.assert_allclose(evaluated(parts, tails), expected - expected[0], atol=2e-3)


def test_heavy_tails_of_named_landmarks() -> None:
    parts = cloud("known")
    apart = residuals(parts, "landmarks", "landmark_mask")
    named = np.flatnonzero(parts[1]["landmark_mask"][0, 0].numpy())
    expected = sum(STUDENT(apart[:, m, name]) for m, name in enumerate(named))
    found = evaluated(parts, student_log_density)
    np.testing.assert_allclose(found, expected - expected[0], atol=2e-3)


@pytest.mark.slow
def test_particles_find_out_which_landmark_is_which(tools: SimpleNamespace) -> None:
    """As well as if it were said, after 3 s."""
    errors = []
    for association in ("known", "unknown"):
        scenario = make_scenario("indoor-v0", association=association, landmarks=8, prior_std=0.5)
        found = tools.score("pf500:particles=200", scenario, 2, 30)
        errors.append(float(found.rmse))
    assert errors[1] < 1.5 * errors[0]
