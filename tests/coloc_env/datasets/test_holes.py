"""Holes in what drives a motion model: a mean stands in, filters and the bound count what it is
off, and nothing changes where there is no hole."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from agents import make
from coloc_env.bounds import posterior_bound
from coloc_env.datasets import Recording, Table, Track
from coloc_env.datasets.grid import Grid, bridged, held_intervals, unknown_on
from coloc_env.datasets.replay import recorded_imu, recorded_motion, recorded_odometry
from coloc_env.motion import Arena
from coloc_env.network import Network
from coloc_env.scenario import Inertial, Prior, Process, Scenario, Wheeled
from coloc_env.sensors import GRAVITY, Imu, Odometry, RecordedSensor, Sensor
from coloc_env.world import World

DT, STEPS = 0.1, 100
HOLE = (3.0, 6.0)  # s
SPREAD = {"odometry": (0.3, 0.4), "imu": (0.05, 0.5)}  # of speed and turn; of gyro, accelerometer
COLUMNS = {"odometry": ("v", "omega"), "imu": tuple("abcdef")}


def recording(stream: str, hole: tuple[float, float] | None, seed: int = 0) -> Recording:
    """A robot that stands at the origin, by its truth; one sensor of 50 samples a second."""
    rng = np.random.default_rng(seed)
    dim, width = (2, 2) if stream == "odometry" else (3, 6)
    time = np.arange(501) * 20_000_000
    scale = np.repeat(SPREAD[stream], width // 2)
    values = scale * rng.standard_normal((501, width))
    if stream == "imu":
        values[:, 5] += GRAVITY
    if hole:
        kept = (time * 1e-9 <= hole[0]) | (time * 1e-9 >= hole[1])
        time, values = time[kept], values[kept]
    truth_time = np.arange(STEPS + 1) * 100_000_000
    attitude = np.zeros((STEPS + 1, 1 if dim == 2 else 4))
    attitude[:, 0] = dim - 2
    return Recording(
        name="made",
        dim=dim,
        robots=("robot",),
        truth=(Track(truth_time, np.zeros((STEPS + 1, dim)), attitude),),
        streams={stream: (Table(time, values, COLUMNS[stream]),)},
        landmarks=np.zeros((0, dim)),
        anchors=np.zeros((0, dim)),
        tags=np.zeros((1, 0, dim)),
        source="none",
    )


def scenario(stream: str, hole: tuple[float, float] | None) -> Scenario:
    made, grid = recording(stream, hole), Grid(0, DT, STEPS + 1)
    sensor: Sensor
    series: RecordedSensor
    process: Process
    if stream == "odometry":
        sensor, process = Odometry(0.02, 0.01, 0.02), Wheeled()
        series = recorded_odometry(made, grid, sensor, held=0.25)
    else:
        sensor, process = Imu(), Inertial()
        series = recorded_imu(made, grid, sensor, np.zeros((1, 6)))
    return Scenario(
        name="made",
        arena=Arena(made.dim, 1, DT, (-10.0,) * made.dim, (10.0,) * made.dim),
        horizon=STEPS,
        motion=recorded_motion(made, grid),
        sensors=(series,),
        network=Network(),
        prior=Prior(0.1, velocity_std=0.01, attitude_std=0.001),
        process=process,
        believed_sensors=(sensor,),
    )


def spreads(task: Scenario) -> torch.Tensor:
    """Standard deviation of the position [K], in m, that dead reckoning states."""
    localizer, world = make("dead_reckoning", task), World(task)
    observation, found = world.reset(0), []
    belief = localizer.reset(observation)
    for _ in range(STEPS):
        belief, estimate = localizer.step(belief, observation)
        found.append(estimate.covariance[0, 0].trace().sqrt())
        world.advance(estimate.action())
        observation = world.observation()
    return torch.stack(found)


def test_a_sample_stands_for_so_long_and_the_mean_from_then_on() -> None:
    table = Table(np.array([0, 100, 1000]) * 10**6, np.array([[1.0], [3.0], [5.0]]), ("x",))
    whole, missing = bridged(table, 0.2, table.values.mean(0))
    assert whole.time.tolist() == [0, 10**8, 3 * 10**8, 10**9]
    assert whole.values[:, 0].tolist() == [1, 3, 3, 5]  # the mean is 3
    assert missing.values[:, 0].tolist() == [0, 0, 1, 0]
    grid = Grid(0, 0.4, 4)
    _, lasting = held_intervals(grid, missing)
    assert lasting.sum(1) == pytest.approx([0, 0.4, 0.4, 0.4])
    share = np.array((0, 0.25, 1, 0.5))
    expected = share[:, None] * [2.0, 7.0] * np.sqrt(2 / 0.4)
    np.testing.assert_allclose(unknown_on(grid, missing, np.array((2.0, 7.0))), expected)


@pytest.mark.parametrize("stream", ["odometry", "imu"])
def test_without_a_hole_there_is_no_such_leaf(stream: str) -> None:
    (sensor,) = scenario(stream, None).sensors
    assert isinstance(sensor, RecordedSensor)
    assert set(sensor.series) == {stream}


@pytest.mark.parametrize("stream", ["odometry", "imu"])
def test_filters_and_the_bound_know_of_a_hole(stream: str) -> None:
    """Both grow by it alike: the bound's variance is that of dead reckoning at the truth."""
    std, bound = [], []
    for hole in (None, HOLE):
        task = scenario(stream, hole)
        std.append(spreads(task))
        bound.append(posterior_bound(task, 1).mse[0, :, 0].sqrt())
    for found in (std, bound):
        assert torch.equal(found[0][:30], found[1][:30])
        assert (found[1][65:] > 2 * found[0][65:]).all()
    for one, other in zip(std, bound, strict=True):
        torch.testing.assert_close(one, other, rtol=0.15, atol=0.01)


def test_what_is_said_to_be_unknown_is_what_the_mean_is_off() -> None:
    """A speed that lasts for a second: over a hole of 3 s its sum is off by as much as is said."""
    rng, hold = np.random.default_rng(1), 50
    grid, held, made = Grid(0, DT, STEPS + 1), 0.25, recording("odometry", None)
    errors, stated = [], []
    for _ in range(400):
        time = np.arange(501) * 20_000_000
        speed = np.repeat(0.3 * rng.standard_normal(11), hold)[:501]
        speed = np.roll(speed, rng.integers(hold))
        table = Table(time, np.stack((speed, 0 * speed), 1), ("v", "omega"))
        gap = (time * 1e-9 <= HOLE[0]) | (time * 1e-9 >= HOLE[1])
        cut = Table(time[gap], table.values[gap], table.columns)
        whole, spoiled = (
            recorded_odometry(replace(made, streams={"odometry": (one,)}), grid, Odometry(), held)
            for one in (table, cut)
        )
        error = (whole.series["odometry"].values - spoiled.series["odometry"].values)[:, 0, 0]
        errors.append(float(error.sum() * DT))
        unknown = spoiled.series["odometry_unknown"].values[:, 0, 0]
        stated.append(float((unknown * DT).square().sum()))
    assert np.std(errors) == pytest.approx(np.mean(stated) ** 0.5, rel=0.35)
