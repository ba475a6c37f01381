"""Measurement models: Jacobians by finite differences, and no residual at the truth."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from agents.models.measurements import Block, Measurement, Neighbours, make_measurements, received
from agents.models.process import Process, make_process
from coloc_env import scenario as settings
from coloc_env.motion import Aggressive, Arena, RandomVelocity
from coloc_env.network import Network
from coloc_env.observation import Observation
from coloc_env.scenario import ConstantVelocity, Inertial, InsDriven, Prior, Scenario, Wheeled
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import (
    AnchorRanging,
    ArrivalAngles,
    Compass,
    Height,
    Imu,
    Ins,
    LandmarkBearings,
    Landmarks,
    Light,
    Magnetic,
    Odometry,
    OpticalFlow,
    PathLoss,
    PositionFix,
    RangeNoise,
    Ranging,
    Rssi,
    Sensor,
    Sight,
    SlowFlight,
    Tdoa,
    UavBearings,
    UavRssi,
    Ultrasonic,
)
from coloc_env.world import World

N, STEP = 3, 1e-5
TAGS = (
    ((0.2, 0.1, -0.1), (-0.3, 0.0, 0.1)),
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ((0.1, -0.3, 0.2), (0.3, 0.1, 0.0)),
)
FLAT_TAGS = tuple(tuple(arm[:2] for arm in arms) for arms in TAGS)
CORNERS = ((0.0, 0.0, 0.0), (10.0, 8.0, 4.0), (0.0, 8.0, 1.0))
FLAT = tuple(corner[:2] for corner in CORNERS)
EXACT = RangeNoise(std=1e-6)
ROOM = ((0.0, 0.0, 0.0), (10.0, 8.0, 4.0))
WALL = (((4.0, 3.0, 0.0), (4.2, 5.0, 4.0)),)
LAMPS = ((2.0, 2.0, 4.0), (8.0, 6.0, 4.0))
KINDS: dict[str, tuple[str, Sensor]] = {
    "landmarks": ("inertial", Landmarks(6, 1e-6, 20.0, dropout=0.2)),
    "landmarks, biases": ("biased", Landmarks(6, 1e-6, 20.0)),
    "landmarks, plane": ("wheeled", Landmarks(6, 1e-6, 20.0)),
    "anchors": ("inertial", AnchorRanging(CORNERS, EXACT)),
    "anchors, velocity": ("velocity", AnchorRanging(CORNERS, EXACT)),
    "anchors, tags": ("inertial", AnchorRanging(CORNERS, EXACT, TAGS)),
    "anchors, plane tags": ("wheeled", AnchorRanging(FLAT, EXACT, FLAT_TAGS)),
    "ranges": ("inertial", Ranging(EXACT)),
    "ranges, velocity": ("velocity", Ranging(EXACT)),
    "ranges, tags": ("inertial", Ranging(EXACT, TAGS)),
    "ranges, plane tags": ("wheeled", Ranging(EXACT, FLAT_TAGS)),
    "landmark bearings": ("wheeled", LandmarkBearings(5, 1e-6, 1e-6, 20.0, 0.7, depth=2)),
    "uav bearings": ("wheeled", UavBearings(1e-6, 1e-6, 0.7, depth=2)),
    "height": ("velocity", Height(1e-6, dropout=0.2)),
    "height, drift": ("velocity", Height(1e-6, bias_std=1e-6, estimated=True)),
    "slow flight": ("velocity", SlowFlight(0.5)),
    "fixes": ("inertial", PositionFix(1e-6, count=2)),
    "fixes, ins": ("ins", PositionFix(1e-6, count=2)),
    "fixes, plane": ("wheeled", PositionFix(1e-6, count=2)),
    "fixes, up": ("inertial", PositionFix(1e-6, 2, 2e-6, outage=0.3, outage_time=1.0)),
    "ranges, ins": ("ins", Ranging(EXACT)),
    "differences": ("inertial", Tdoa(CORNERS, 1e-6, dropout=0.2)),
    "differences, velocity": ("velocity", Tdoa(CORNERS, 1e-6, pairs=((2, 0), (0, 1)), depth=2)),
    "differences, tags": ("inertial", Tdoa(CORNERS, 1e-6, TAGS, depth=2)),
    "differences, plane tags": ("wheeled", Tdoa(FLAT, 1e-6, FLAT_TAGS)),
    "arrival angles": ("inertial", ArrivalAngles(1e-6, 1e-6, dropout=0.2, depth=2)),
    "arrival angles, biases": ("biased", ArrivalAngles(1e-6, 1e-6)),
    "flow": ("inertial", OpticalFlow(1e-6, dropout=0.2)),
    "flow, biases": ("biased", OpticalFlow(1e-6)),
    "compass": ("inertial", Compass(1e-6, dropout=0.2)),
    "compass, biases": ("biased", Compass(1e-6)),
    "compass, plane": ("wheeled", Compass(1e-6)),
    "lamps": ("inertial", Light(LAMPS, share=0.0, floor=1e-6, angle_std=1e-6, sight=Sight(WALL))),
    "strengths": ("inertial", Rssi(CORNERS, PathLoss(1e-6, walls=WALL), dropout=0.2)),
    "strengths, velocity": ("velocity", Rssi(CORNERS, PathLoss(1e-6))),
    "strengths, plane": ("wheeled", Rssi(FLAT, PathLoss(1e-6))),
    "uav strengths": ("inertial", UavRssi(PathLoss(1e-6), dropout=0.2)),
    "uav strengths, plane": ("wheeled", UavRssi(PathLoss(1e-6))),
    "ultrasound": ("inertial", Ultrasonic(ROOM, 1e-6, 8.0, walls=WALL)),
    "magnetic": ("inertial", Magnetic(ROOM, 1e-6, map_std=0.0, dropout=0.2)),
    "magnetic, biases": ("biased", Magnetic(ROOM, 1e-6, map_std=0.0)),
}


@dataclass
class Setting:
    """A sensor's model somewhere near the truth: what ``linearize`` takes."""

    model: Measurement
    process: Process
    truth: Tensor
    observation: Observation
    neighbours: Neighbours

    def block(self, x: Tensor | None = None, neighbours: Neighbours | None = None) -> Block:
        x = self.truth if x is None else x
        return self.model.linearize(
            self.process, x, self.observation, neighbours or self.neighbours
        )


@pytest.fixture(params=KINDS)
def setting(request: pytest.FixtureRequest) -> Setting:
    kind, sensor = KINDS[request.param]
    dim = 2 if kind == "wheeled" else 3
    driver: dict[str, tuple[Sensor, ...]] = {
        "wheeled": (Odometry(),),
        "velocity": (),
        "ins": (Ins(),),
    }
    moved = {
        "wheeled": Wheeled(),
        "velocity": ConstantVelocity(),
        "biased": Inertial(0.1, 0.01),
        "ins": InsDriven(),
    }
    sensors = (*driver.get(kind, (Imu(),)), sensor)
    scenario = Scenario(
        name="models",
        arena=Arena(dim, N, 0.1, (0.0,) * dim, (10.0, 8.0, 4.0)[:dim]),
        horizon=50,
        motion=Aggressive() if dim == 3 else RandomVelocity(),
        sensors=sensors,
        network=Network(),
        prior=Prior(),
        process=moved.get(kind, Inertial()),
        believed_sensors=sensors,
    )
    world = World(scenario, 4)
    world.reset(0)
    for _ in range(3):
        world.advance(torch.zeros(4, N, 3 * dim))
    truth, process = world.truth, make_process(scenario.believed)
    pose = [truth.position, truth.velocity, truth.attitude]
    x = torch.cat(pose[: 3 if process.attitude_size else 2], -1)
    x = torch.nn.functional.pad(x, (0, process.state_size - x.shape[-1]))
    place = truth.position.unsqueeze(1).expand(-1, N, -1, -1)
    g = torch.Generator().manual_seed(1)
    variance = torch.rand(place.shape, generator=g, dtype=torch.float64)
    known = torch.ones(4, N, N, dtype=torch.bool)
    (model,) = make_measurements(scenario.believed)
    return Setting(model, process, x, world.observation(), Neighbours(place, variance, known))


def off(setting: Setting) -> Tensor:
    """States near the truth, but not at it."""
    g = torch.Generator().manual_seed(2)
    shape = (*setting.truth.shape[:2], setting.process.error_size)
    return setting.process.boxplus(
        setting.truth, 0.2 * torch.randn(shape, generator=g, dtype=torch.float64)
    )


def slots(block: Block, count: int) -> Tensor:
    """Which neighbour slot each of the block's measurements is of [m]."""
    index = torch.arange(block.residual.shape[-2])
    return index // block.per_slot % count


def seen(block: Block, value: Tensor) -> Tensor:
    """A value [B, N, m, …] of the measurements that arrived."""
    return value[block.mask]


# ---------------------------------------------------------------- against the world


def test_at_the_truth_there_is_no_residual(setting: Setting) -> None:
    """But for what the model cannot know: where the tags are on other UAVs, or at no attitude."""
    block = setting.block()
    assert block.mask.any()
    assert not block.mask.all() or not isinstance(setting.model, Ranging)
    residual = block.residual
    tags = getattr(setting.model, "tags", ())
    if setting.model.cooperative and tags:
        bare = slots(block, N) == 1  # UAV 1's tags have no lever arm
        assert residual[:, :, ~bare][block.mask[:, :, ~bare]].abs().max() > 0.05
        residual, mask = residual[:, :, bare], block.mask[:, :, bare]
        assert residual[mask].abs().max() < 1e-4
    elif type(setting.model).__name__ == "Slowness":
        expected = -setting.truth[..., None, 3:6]
        torch.testing.assert_close(residual, expected)
    else:
        assert seen(block, residual).abs().max() < 1e-4


# ---------------------------------------------------------------- derivatives


def test_own_jacobian_is_the_derivative(setting: Setting) -> None:
    x = off(setting)
    block, columns = setting.block(x), []
    for direction in torch.eye(setting.process.error_size, dtype=torch.float64):
        ends = [
            setting.block(setting.process.boxplus(x, s * direction)).residual for s in (STEP, -STEP)
        ]
        columns.append((ends[1] - ends[0]) / (2 * STEP))  # of h = z − residual
    expected = torch.stack(columns, -1)
    assert seen(block, expected).abs().max() > 0.1
    torch.testing.assert_close(
        seen(block, block.jacobian), seen(block, expected), rtol=1e-8, atol=1e-8
    )


def test_partner_jacobian_is_the_derivative(setting: Setting) -> None:
    """The residual of a slot's measurement, by that slot's position and by no other."""
    if not setting.model.cooperative:
        assert setting.block().partner is None
        return
    x, near, d = off(setting), setting.neighbours, setting.process.dim
    block = setting.block(x)
    assert block.partner is not None
    of = slots(block, N)
    for slot in range(N):
        for axis in range(d):
            ends = []
            for s in (STEP, -STEP):
                place = near.position.clone()
                place[:, :, slot, axis] += s
                ends.append(setting.block(x, replace(near, position=place)).residual)
            change = (ends[1] - ends[0]) / (2 * STEP)
            expected = torch.where((of == slot)[:, None], block.partner[..., axis], 0.0)
            torch.testing.assert_close(
                seen(block, change), seen(block, expected), rtol=0, atol=1e-8
            )


def test_partner_variance_is_carried_through_the_derivative(setting: Setting) -> None:
    block = setting.block(off(setting))
    if block.partner is None:
        torch.testing.assert_close(block.total_variance, block.variance)
        return
    theirs = setting.neighbours.variance[:, :, slots(block, N)]
    expected = (block.partner**2 * theirs.unsqueeze(-2)).sum(-1)
    expected = expected + getattr(setting.model, "their_arms", 0.0)
    assert block.partner_variance is not None
    torch.testing.assert_close(seen(block, block.partner_variance), seen(block, expected))
    torch.testing.assert_close(block.total_variance, block.variance + block.partner_variance)


def test_without_derivatives_the_rest_is_the_same(setting: Setting) -> None:
    """And for particles, whose states have a dimension more, too."""
    x = off(setting)
    whole = setting.block(x)
    particles = torch.stack((x, setting.truth), 2)
    wide = Observation(
        {name: leaf.unsqueeze(2) for name, leaf in setting.observation.leaves.items()}
    )
    near = Neighbours(
        *(getattr(setting.neighbours, n).unsqueeze(2) for n in ("position", "variance", "known"))
    )
    part = setting.model.linearize(setting.process, particles, wide, near, derivatives=False)
    torch.testing.assert_close(part.residual[:, :, 0], whole.residual)
    torch.testing.assert_close(part.total_variance[:, :, 0], whole.total_variance)
    assert torch.equal(part.mask.expand(-1, -1, 2, -1)[:, :, 0], whole.mask)


# ---------------------------------------------------------------- details


def test_unknown_lever_arms_count_as_noise(setting: Setting) -> None:
    """What tags with no attitude, or on other UAVs, add to the variance: that of random turns."""
    tags = getattr(setting.model, "tags", None)
    if not tags:
        return
    arms = torch.tensor(tags.arms, dtype=torch.float64)
    mean = (arms**2).sum(-1).mean() / arms.shape[-1]
    if setting.model.cooperative:
        assert setting.model.their_arms == pytest.approx(float(mean))


def test_messages_are_moved_to_now() -> None:
    """A message says where its sender was 1 + delay steps ago, and how fast it went."""
    believed = SimpleNamespace(arena=SimpleNamespace(dim=2, dt=0.1), slots=2, message_delay=2)
    sent = torch.tensor([[[1.0, 2.0, 3.0, 4.0, -1.0, -2.0] * 2]])
    near = received(
        believed, Observation({"messages": sent, "message_mask": torch.tensor([[[1.0, 0.0]]])})
    )
    torch.testing.assert_close(
        near.position[0, 0, 0], torch.tensor([1.9, 3.2]).double(), rtol=1e-6, atol=0
    )
    torch.testing.assert_close(
        near.variance[0, 0, 0], torch.tensor([-2.0, -4.0]).double().exp(), rtol=1e-6, atol=0
    )
    assert near.known.tolist() == [[[True, False]]]


@pytest.mark.parametrize(
    ("process", "sensor", "words"),
    [
        (InsDriven(), Landmarks(3), "Landmarks are in the body frame: the motion model has no att"),
        (ConstantVelocity(), UavBearings(), "UavBearings are in the body frame"),
        (InsDriven(), SlowFlight(0.5), "SlowFlight is about velocity, which InsDriven motion does"),
        (Wheeled(), SlowFlight(0.5), "SlowFlight is about velocity, which Wheeled motion does not"),
    ],
)
def test_sensors_of_what_is_no_state_are_refused(
    process: settings.Process, sensor: Sensor, words: str
) -> None:
    believed = make_scenario("swarm-v0", n_uavs=3).believed
    with pytest.raises(ValueError, match=words):
        make_measurements(replace(believed, process=process, sensors=(sensor,)))
