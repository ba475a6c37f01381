"""A sensor of one's own: sensed, believed, bounded and used, with nothing of ours touched."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import pytest
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from agents import make
from agents.models.measurements import MODELS, Block, Measurement, Neighbours, measures
from agents.models.process import Process
from coloc_env import noise
from coloc_env.bounds.information import own_information
from coloc_env.bounds.posterior import posterior_bound
from coloc_env.geometry import rotation_matrix
from coloc_env.motion import Kinematics
from coloc_env.observation import Observation
from coloc_env.options import Metres
from coloc_env.scenario import Scenario, TeamOptions
from coloc_env.scenarios import SCENARIOS, make_scenario
from coloc_env.sensors import Layout, Leaf, Sensor, Window
from coloc_env.world import World

STEPS, WORLDS, STD = 60, 40, 0.3


@dataclass(frozen=True)
class Beacon(Sensor):
    """Leaf ``beacon`` [d]: where the arena's centre is, seen from the UAV, in its body frame (m),
    with Gaussian noise ``std`` per axis."""

    std: float = STD

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {"beacon": Leaf(layout.arena.dim)}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        motion = window.motion
        apart = motion.position.new_tensor(window.layout.arena.centre) - motion.position
        seen = (apart.unsqueeze(-2) @ rotation_matrix(motion.attitude)).squeeze(-2).float()
        white = noise.normal(window.keys, "beacon", seen[0, 0].numel()).view(seen.shape)
        return {"beacon": (seen + self.std * white) * window.alive.unsqueeze(-1)}


class BeaconVectors(Measurement):
    """z = Rᵀ(c − p) + noise, with the attitude taken as known."""

    def __init__(self, sensor: Beacon) -> None:
        self.variance, self.centre = sensor.std**2, CENTRE

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        rotation, d = process.rotation(x), process.dim
        assert rotation is not None
        z = observation["beacon"].to(x.dtype)
        expected = ((x.new_tensor(self.centre) - x[..., :d]).unsqueeze(-2) @ rotation).squeeze(-2)
        residual = (z - expected).unsqueeze(-2)
        jacobian = x.new_zeros(*residual.shape, process.error_size)
        jacobian[..., 0, :, :d] = -rotation.mT
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=x.new_tensor(self.variance).expand_as(residual),
            mask=torch.ones(residual.shape[:-1], dtype=torch.bool),
        )


CENTRE = (15.0, 10.0, 2.5)


def beacon_room(*, beacon_std: Metres = STD, team: TeamOptions = TeamOptions()) -> Scenario:  # noqa: B008
    """A room in which UAVs see a beacon and nothing else."""
    plain = make_scenario("indoor-v0", n_uavs=team.n_uavs, landmarks=0, uwb=False)
    beacon = Beacon(beacon_std)
    own = (*plain.sensors, beacon)
    return replace(plain, name="beacon-v0", sensors=own, believed_sensors=own)


@pytest.fixture(autouse=True)
def beacons() -> Iterator[None]:
    """All that a package of one's own does when it is imported."""
    measures(Beacon)(BeaconVectors)

    @own_information.register
    def _(sensor: Beacon, truth: Kinematics, seen: Observation) -> Float64[Tensor, "B N D D"]:
        information = truth.position.new_zeros(*truth.position.shape[:2], 6, 6)
        information[..., :3, :3] = torch.eye(3, dtype=torch.float64) / sensor.std**2
        return information

    SCENARIOS.register("beacon-v0")(beacon_room)
    yield
    SCENARIOS.remove("beacon-v0")
    del MODELS[Beacon]


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
    world = World(make_scenario("beacon-v0", n_uavs=2), WORLDS)
    seen = world.reset(torch.arange(WORLDS))["beacon"]
    apart = torch.tensor(CENTRE, dtype=torch.float64) - world.truth.position
    exact = apart.unsqueeze(-2) @ rotation_matrix(world.truth.attitude)
    error = (seen - exact.squeeze(-2)).flatten()
    assert float(error.std()) == pytest.approx(STD, rel=4 / (2 * len(error)) ** 0.5)


def test_its_information_sharpens_the_bound() -> None:
    scenario = make_scenario("beacon-v0", n_uavs=2)
    blind = replace(scenario, sensors=scenario.sensors[:1])
    with_beacon, without = (posterior_bound(s, 8, steps=STEPS).rmse for s in (scenario, blind))
    assert 0 < with_beacon < 0.5 * without


def test_an_ekf_uses_it() -> None:
    """It beats dead reckoning by far, and no more than the bound allows."""
    scenario = make_scenario("beacon-v0", n_uavs=2)
    bound = posterior_bound(scenario, WORLDS, steps=STEPS).position[10:].square().mean().sqrt()
    ekf = rmse("ekf", scenario)
    assert ekf < 0.5 * rmse("dead_reckoning", scenario)
    assert 0.9 * bound < ekf < 1.5 * bound


def test_what_extends_a_sensor_has_its_model() -> None:
    """A subclass is measured and bounded as the sensor that it extends is."""

    @dataclass(frozen=True)
    class Lamp(Beacon):
        pass

    plain = make_scenario("beacon-v0", n_uavs=2)
    lit = (*plain.sensors[:1], Lamp())
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

    plain = make_scenario("beacon-v0", n_uavs=2)
    other = replace(plain, sensors=(*plain.sensors, Whistle()))
    alone = posterior_bound(other, 2, steps=5, cooperative=False)
    assert torch.equal(alone.mse, posterior_bound(plain, 2, steps=5, cooperative=False).mse)
    with pytest.raises(NotImplementedError, match="no Fisher information is known for Whistle"):
        posterior_bound(other, 2, steps=5)
