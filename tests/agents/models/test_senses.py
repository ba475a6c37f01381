"""Filters with lamps, signal strength, ultrasound, a compass and a magnetic map: likelihoods as
scipy has them, honest covariances, errors near the bound."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import norm, vonmises_fisher

from agents import make
from agents.models.measurements import Block, make_measurements, no_neighbours
from agents.particle.likelihood import log_likelihood
from agents.robust import Trust
from coloc_env.bounds import posterior_bound
from coloc_env.scenarios import make_scenario
from coloc_env.world import World
from tests.agents.models.test_field_sensors import RANGED, clouds
from tests.sampling import first_fast

SENSES = ("compass", "light", "rssi", "rssi_uavs", "ultrasonic", "magnetic")
OTHERS = (
    *("ukf", "ekf_joint", "ekf:fusion=ci", "ekf:fusion=pairwise", "ekf:fusion=exchange"),
    *("ekf:robust=huber+gate", "emvf", "dfgo", "dfgo_central", "ekf_trust", "pf500:proposal=ekf"),
    *("apf", "pfnn", "pf_trust", "dlspf"),
)


def test_log_likelihood_of_lamps_is_scipys() -> None:
    """Of intensities whose noise grows with them, and of directions, up to a constant per UAV."""
    scenario = make_scenario("indoor-v0", **RANGED, light=True, lamps=3, light_share=0.3)
    x, seen, process, models, _ = clouds(scenario)
    around, centre = no_neighbours(x[:, :, 0, :3]), x[:, :, 0]
    found = log_likelihood(models, process, x, centre, seen, around, [Trust()])[0].numpy()
    lamps = np.array(scenario.sensors[-1].lamps)  # type: ignore[attr-defined]
    for i in range(x.shape[1]):
        mask = seen["light_mask"][0, i].numpy() > 0
        z = seen["light"][0, i].double().numpy()
        ways = seen["light_direction"][0, i].double().numpy().reshape(-1, 3)
        wanted = []
        for one in x[0, i].numpy():
            v = lamps - one[:3]
            r = np.linalg.norm(v, axis=-1)
            size = 1000 * v[:, 2] / r / (r**2 + 0.1) + 20
            u = Rotation.from_quat(np.roll(one[6:], -1)).inv().apply(v / r[:, None])
            total = norm.logpdf(z, size, np.sqrt((0.3 * size) ** 2 + 0.25))[mask].sum()
            for way, true in zip(ways[mask], u[mask], strict=True):
                way = way / np.linalg.norm(way)
                total += vonmises_fisher(true / np.linalg.norm(true), 1 / 0.05**2).logpdf(way)
            wanted.append(total)
        wanted = np.array(wanted)
        np.testing.assert_allclose(found[i] - found[i, 0], wanted - wanted[0], rtol=1e-4, atol=5e-3)
        assert np.ptp(wanted) > 0.05


def test_what_linearizing_neglects_counts_as_noise() -> None:
    """½ (‖M‖ σ²)² for ½ δᵀ M δ, at a lamp right above, against sampling."""
    scenario = make_scenario(
        "indoor-v0", **RANGED, n_uavs=1, light=True, lamps=1, light_radius=99.0
    )
    world, (model,) = World(scenario), make_measurements(scenario.believed)
    seen, process = world.reset(0), make("ekf", scenario).process  # type: ignore[attr-defined]
    x = torch.tensor([[[15.0, 10.0, 1.0, 0, 0, 0, 1, 0, 0, 0]]], dtype=torch.float64)

    def block(at: torch.Tensor) -> Block:
        return model.linearize(process, at, seen, no_neighbours(at[..., :3]))

    here, std = block(x), 0.2
    wider = here.curved(torch.eye(3, dtype=torch.float64).expand(1, 1, 3, 3) * std**2)
    added = (wider.variance - here.variance)[0, 0, 0]
    g = torch.Generator().manual_seed(0)
    delta = std * torch.randn(4000, 1, 3, generator=g, dtype=torch.float64)
    moved = torch.cat((x[0, :, :3] + delta, x[0, :, 3:].expand(4000, 1, 7)), -1)
    wide = type(seen)({k: v.expand(4000, -1, -1) for k, v in seen.leaves.items()})
    there = model.linearize(process, moved, wide, no_neighbours(moved[..., :3]))
    linear = (here.jacobian[0, 0, 0, :, :3] @ delta.mT)[..., 0]  # [4000, 4]
    left = (here.residual[0, 0, 0] - there.residual[:, 0, 0]) - linear
    assert bool((left.var(0) < 1.3 * added).all())
    assert float(added[0]) < 2 * float(left[:, 0].var())


@pytest.mark.parametrize("agent", first_fast("ekf", "pf500", *OTHERS))
def test_all_senses_at_once_are_served(agent: str) -> None:
    """By every filter that serves whatever has a model: finite, and near the truth."""
    scenario = make_scenario(
        "indoor-v0", n_uavs=2, landmarks=5, anchors=4, **dict.fromkeys(SENSES, True)
    )
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


@pytest.mark.parametrize("sense", SENSES)
def test_swarm_methods_refuse_what_they_would_ignore(sense: str) -> None:
    scenario = make_scenario("indoor-v0", landmarks=0, anchors=4, **{sense: True})
    with pytest.raises(ValueError, match="would be ignored"):
        make("map", scenario)


def test_without_an_attitude_what_is_of_the_body_is_refused() -> None:
    scenario = make_scenario("indoor-v0", landmarks=0, anchors=4, imu=False, ultrasonic=True)
    with pytest.raises(ValueError, match="Ultrasonic are in the body frame"):
        make("ekf", scenario)


def played(sense: str, **overrides: Any) -> tuple[float, float, float]:
    """RMSE (m), NEES and bound (m) of ``ekf`` after the start, over 20 worlds of 100 steps."""
    settings = {**RANGED, "n_uavs": 3, "anchors": 8, sense: True, **overrides}
    scenario = make_scenario("indoor-v0", **settings)
    rows, steps, start = 20, 100, 20
    world, localizer = World(scenario, rows), make("ekf", scenario)
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
    bound = posterior_bound(scenario, rows, steps=steps).rmse_after(0.1 * start)
    rmse = float(torch.stack(squared[start:]).mean().sqrt())
    return rmse, float(torch.stack(nees[start:]).mean()), bound


@pytest.mark.slow
@pytest.mark.parametrize("sense", [s for s in SENSES if s != "rssi_uavs"])
def test_covariances_are_honest_and_errors_near_the_bound(sense: str) -> None:
    """But for a magnetic map, whose error the bound does not count."""
    rmse, nees, bound = played(sense)
    assert 0.9 * bound < rmse < (4 if sense == "magnetic" else 1.35) * bound
    assert 2.0 < nees < 3.9


SMALL: dict[str, Any] = {"motion": "random", "room": (12.0, 10.0, 5.0)}


@pytest.mark.slow
def test_ultrasound_by_the_walls_stays_honest() -> None:
    """Where beams go from one wall to another as UAVs turn."""
    rmse, nees, bound = played("ultrasonic", landmarks=5, anchors=0, **SMALL)
    assert rmse < 1.3 * bound
    assert nees < 4.0


@pytest.mark.slow
def test_particles_find_the_right_wall() -> None:
    """Beams are sharp, and from 2 m off the wrong wall looks right: errors halve all the same."""
    errors = []
    for ultrasonic in (False, True):
        settings = {**RANGED, **SMALL, "n_uavs": 3, "anchors": 8, "ultrasonic": ultrasonic}
        scenario = make_scenario("indoor-v0", **settings)
        world, localizer = World(scenario, 6), make("pf500", scenario)
        seen = world.reset(torch.arange(6))
        belief, squared = localizer.reset(seen), []
        for _ in range(40):
            belief, estimate = localizer.step(belief, seen)
            squared.append((estimate.position - world.truth.position).square().sum(-1))
            world.advance(estimate.action())
            seen = world.observation()
        errors.append(float(torch.stack(squared)[15:].mean().sqrt()))
    assert errors[1] < 0.7 * errors[0]


def test_a_stray_measurement_costs_so_much_and_no_more() -> None:
    """log(e^(−q / 2) + ρ): what particles lose by a beam that shows something else."""
    scenario = make_scenario("indoor-v0", **RANGED, n_uavs=2, ultrasonic=True)
    x, seen, process, models, _ = clouds(scenario)
    model = models[0]
    far = x.clone()
    far[..., 2] += torch.linspace(0, 2, x.shape[2], dtype=x.dtype)
    around = no_neighbours(x[:, :, 0, :3])
    found = log_likelihood(models, process, far, far[:, :, 0], seen, around, [Trust()])
    block = model.linearize(process, far.flatten(1, 2), _each(seen, x.shape[2]), around, False)
    q = (block.residual**2 / block.variance)[..., 0].unflatten(1, x.shape[1:3])
    mask = seen["ultrasonic_mask"].unsqueeze(2) > 0
    wanted = ((-0.5 * q).exp() + block.stray).log().masked_fill(~mask, 0.0).sum(-1)
    torch.testing.assert_close(found, wanted)
    assert 0 < block.stray < 0.01


def _each(seen: Any, count: int) -> Any:
    """Leaves repeated for every particle."""
    return type(seen)({k: v.repeat_interleave(count, 1) for k, v in seen.leaves.items()})
