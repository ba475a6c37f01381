"""A sensor of one's own: sensed, believed, bounded and used, with nothing of ours touched."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import pytest
import torch
from coloc_example.beacon import Beacon, BeaconVectors, beacon_room
from torch import Tensor

from agents import make
from agents.models.measurements import no_neighbours
from agents.models.process import make_process
from coloc_env.bounds.posterior import posterior_bound
from coloc_env.geometry import rotation_matrix
from coloc_env.scenario import Scenario
from coloc_env.scenarios import SCENARIOS, make_scenario
from coloc_env.sensors import Layout, Leaf, Window
from coloc_env.world import World

STEPS, WORLDS, STD, STEP = 60, 40, 0.3, 1e-6
CENTRE = (15.0, 10.0, 2.5)


@pytest.fixture(autouse=True)
def beacons() -> Iterator[None]:
    """What the package's entry point does; its module registered the model and the information."""
    SCENARIOS.register("beacon-room-v0")(beacon_room)
    yield
    SCENARIOS.remove("beacon-room-v0")


def rmse(agent: str, scenario: Scenario) -> float:
    """Root mean square error (m) of the position, from step 10 on."""
    world, localizer = World(scenario, WORLDS), make(agent, scenario)
    seen = world.reset(torch.arange(WORLDS))
    belief, squared = localizer.reset(seen), []
    for _ in range(STEPS):
        belief, estimate = localizer.step(belief, seen)
        squared.append((estimate.position - world.truth.position).square().sum(-1))
        world.advance(estimate.action())
        seen = world.observation()
    return float(torch.stack(squared)[10:].mean().sqrt())


def test_the_leaf_is_what_the_sensor_measures() -> None:
    world = World(make_scenario("beacon-room-v0", n_uavs=2), WORLDS)
    seen = world.reset(torch.arange(WORLDS))["beacon"]
    apart = torch.tensor(CENTRE, dtype=torch.float64) - world.truth.position
    exact = apart.unsqueeze(-2) @ rotation_matrix(world.truth.attitude)
    error = (seen - exact.squeeze(-2)).flatten()
    assert float(error.std()) == pytest.approx(STD, rel=4 / (2 * len(error)) ** 0.5)


def test_its_jacobian_is_that_of_finite_differences() -> None:
    scenario = make_scenario("beacon-room-v0", n_uavs=2)
    process, model = make_process(scenario.believed), BeaconVectors(Beacon(CENTRE))
    observation = World(scenario, 3).reset(torch.arange(3))
    x = process.initial(observation["prior"].double())[0]
    x = process.boxplus(x, 0.3 * torch.randn(*x.shape[:2], process.error_size, dtype=x.dtype))
    none = no_neighbours(x[..., :3])
    jacobian = model.linearize(process, x, observation, none).jacobian
    for i, axis in enumerate(torch.eye(process.error_size, dtype=x.dtype)):
        ahead, behind = (
            model.linearize(process, process.boxplus(x, step * axis), observation, none, False)
            for step in (STEP, -STEP)
        )
        numeric = (behind.residual - ahead.residual) / (2 * STEP)  # of h = z − residual
        torch.testing.assert_close(jacobian[..., i], numeric, atol=1e-6, rtol=1e-6)


def test_its_information_sharpens_the_bound() -> None:
    scenario = make_scenario("beacon-room-v0", n_uavs=2)
    blind = replace(scenario, sensors=scenario.sensors[:1])
    with_beacon, without = (posterior_bound(s, 8, steps=STEPS).rmse for s in (scenario, blind))
    assert 0 < with_beacon < 0.5 * without


def test_an_ekf_uses_it() -> None:
    """It beats dead reckoning by far, and no more than the bound allows."""
    scenario = make_scenario("beacon-room-v0", n_uavs=2)
    bound = posterior_bound(scenario, WORLDS, steps=STEPS).position[10:].square().mean().sqrt()
    ekf = rmse("ekf", scenario)
    assert ekf < 0.5 * rmse("dead_reckoning", scenario)
    assert 0.9 * bound < ekf < 1.5 * bound


def test_what_extends_a_sensor_has_its_model() -> None:
    """A subclass is measured and bounded as the sensor that it extends is."""

    @dataclass(frozen=True)
    class Lamp(Beacon):
        pass

    plain = make_scenario("beacon-room-v0", n_uavs=2)
    lit = (*plain.sensors[:1], Lamp(CENTRE))
    other = replace(plain, sensors=lit, believed_sensors=lit)
    assert rmse("ekf", other) == rmse("ekf", plain)
    assert posterior_bound(other, 2, steps=5).rmse == posterior_bound(plain, 2, steps=5).rmse


def test_a_sensor_between_uavs_counts_for_the_team_alone() -> None:
    """Its information is asked for as shared, and not at all where UAVs do not cooperate."""

    @dataclass(frozen=True)
    class Whistle(Beacon):
        between_uavs = True

        def leaves(self, layout: Layout) -> dict[str, Leaf]:
            return {"whistle": Leaf(layout.arena.dim)}

        def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
            return {"whistle": super().sample(window, placed)["beacon"]}

    plain = make_scenario("beacon-room-v0", n_uavs=2)
    other = replace(plain, sensors=(*plain.sensors, Whistle(CENTRE)))
    alone = posterior_bound(other, 2, steps=5, cooperative=False)
    assert torch.equal(alone.mse, posterior_bound(plain, 2, steps=5, cooperative=False).mse)
    with pytest.raises(NotImplementedError, match="no Fisher information is known for Whistle"):
        posterior_bound(other, 2, steps=5)
