"""The auxiliary, mixture and Rao–Blackwellized particle filters. That they tend to the Kalman
filter: ``test_linear``."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from filterpy.kalman import KalmanFilter
from scipy.stats import multivariate_normal

from agents import make
from agents.errors import NotServed
from agents.models.process import make_process
from agents.particle import mixture
from agents.particle.cloud import moments
from coloc_env.observation import Observation
from coloc_env.scenarios import make_scenario
from training.evaluation.record import record

RIVALS = ("pf_auxiliary", "pf_mixture", "pf_rao_blackwell")


@pytest.mark.parametrize("name", RIVALS)
def test_the_room_is_localized(name: str, tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2)
    found, plain = (tools.score(f"{one}:particles=300", scenario, 2, 30) for one in (name, "pf500"))
    assert found.rmse < 1.5 * plain.rmse


@pytest.mark.parametrize("name", RIVALS)
def test_biases_that_would_be_ignored_are_refused(name: str, tools: SimpleNamespace) -> None:
    with pytest.raises(NotServed, match=f"{name}: the biases .* would be ignored"):
        make(name, tools.families["biased"]())


# ---------------------------------------------------------------- auxiliary


def test_looking_ahead_leaves_more_particles(tools: SimpleNamespace) -> None:
    """Motion is nearly certain here, so second-stage weights are nearly even."""
    scenario, share = make_scenario("indoor-v0", n_uavs=2), {}
    for name in ("pf500", "pf_auxiliary"):
        beliefs = tools.play(make(name, scenario, particles=300), scenario, [0, 1], 15).beliefs
        share[name] = torch.stack([b.ess_share for b in beliefs[6:]]).mean()
    assert share["pf_auxiliary"] > 1.1 * share["pf500"]


# ---------------------------------------------------------------- mixture


@pytest.mark.parametrize(("carried", "found"), [(1e-6, True), (0.0, False)])
def test_a_carried_uav_is_found_by_what_it_measures(
    carried: float, found: bool, tools: SimpleNamespace
) -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2, kidnap_at=0.8, kidnapped=(0,))
    localizer = make("pf_mixture", scenario, particles=200, carried=carried)
    error = record(localizer, replace(scenario, horizon=14), torch.arange(2)).error
    assert bool((error[:, 9, 0] < 0.5).all()) is found
    assert (error[:, -1, 1] < 0.5).all()


def test_densities_are_those_of_scipy() -> None:
    g = torch.Generator().manual_seed(0)
    root = torch.randn(1, 1, 4, 4, generator=g, dtype=torch.float64)
    covariance, x = root @ root.mT, torch.randn(1, 1, 7, 4, generator=g, dtype=torch.float64)
    found = mixture._log_normal(x, covariance)[0, 0]
    theirs = multivariate_normal(np.zeros(4), covariance[0, 0].numpy()).logpdf(x[0, 0].numpy())
    np.testing.assert_allclose(found, theirs, rtol=1e-9)


def test_both_kinds_of_particles_stand_for_the_motion_prior(tools: SimpleNamespace) -> None:
    """Before the evidence their moments are the predicted cloud's, as far as there are particles:
    many for a prior as broad as what is measured tells."""
    scenario = make_scenario("indoor-v0", n_uavs=2, landmarks=4)
    localizer: Any = make("pf_mixture", scenario, particles=20_000, share=0.3, carried=0.0)
    observation = tools.play(localizer, scenario, [0], 1).observations[0]
    belief, mixed = localizer.reset(observation), {}
    evidence = localizer._evidence

    def watched(particles: Any, log_weights: Any, now: Any) -> Any:
        mixed["cloud"] = moments(localizer.process, particles, log_weights.exp())
        return evidence(particles, log_weights, now)

    localizer._evidence = watched
    localizer.step(belief, observation)
    before = moments(localizer.process, belief.particles, belief.log_weights.exp())
    after, std = mixed["cloud"], before.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    apart = localizer.process.boxminus(after.mean, before.mean) / std
    assert apart.abs().max() < 0.06
    ratio = after.covariance.diagonal(dim1=-2, dim2=-1).sqrt() / std
    assert (ratio - 1).abs().max() < 0.06


# ---------------------------------------------------------------- Rao–Blackwell


def test_the_rest_is_known_as_if_positions_were_measured(tools: SimpleNamespace) -> None:
    """Of velocities, each particle knows what a Kalman filter knows to whom positions are given."""
    team = tools.linear.believed
    localizer: Any = make("pf_rao_blackwell", team, particles=50)
    localizer.models = []
    process, dt = make_process(team), torch.tensor(team.arena.dt).double()
    x = torch.zeros(6, dtype=torch.float64)
    f, q = (m.numpy() for m in process.linearize(x, x[:0], dt))
    textbook = KalmanFilter(6, 3)
    textbook.F, textbook.Q, textbook.H = f, q, np.eye(3, 6)
    textbook.R, textbook.P = 1e-12 * np.eye(3), np.diag([0.0] * 3 + [0.5**2] * 3)
    prior = torch.zeros(1, 3, 15)
    prior[..., 6], prior[..., 10:13], prior[..., 13] = 1.0, 1.5, 0.5
    seen = Observation({"prior": prior})
    belief = localizer.reset(seen)
    assert belief.particles[..., 3:].std() == 0
    for k in range(6):
        belief, _ = localizer.step(belief, seen)
        if k:
            textbook.predict()
            textbook.update(np.zeros(3))
        own = belief.conditional[0, 1].numpy()
        np.testing.assert_allclose(own, textbook.P[3:, 3:], rtol=1e-6, atol=1e-9)


def test_few_particles_do_where_the_rest_is_marginalized(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2)
    few, plain = (
        tools.score(f"{name}:particles=60", scenario, 2, 40).rmse
        for name in ("pf_rao_blackwell", "pf500")
    )
    assert few < 0.8 * plain
