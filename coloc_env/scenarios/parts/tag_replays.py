"""Parts of scenarios that replay one tag in the plane among anchors."""

from dataclasses import replace

import numpy as np

from coloc_env.datasets import Recording, Table
from coloc_env.datasets.grid import Grid, common_grid
from coloc_env.datasets.replay import (
    arena_of,
    recorded_anchor_ranges,
    recorded_motion,
    recorded_odometry,
)
from coloc_env.network import Network
from coloc_env.scenario import Prior, Process, Reward, Scenario
from coloc_env.scenarios.parts.replays import ReplayOptions
from coloc_env.sensors import AnchorRanging, Odometry, RangeNoise, Sensor

_HELD = 0.25  # s, for which a sample of odometry stands: two steps of the robot's


def corrected(recording: Recording, delay: float, bias: float) -> Recording:
    """The recording with its ranges ``delay`` s older than their stamps and ``bias`` m shorter."""
    (ranges,) = recording.streams["anchor_ranges"]
    values = ranges.values - bias * (np.array(ranges.columns) == "range")
    table = Table(ranges.time - round(delay * 1e9), values, ranges.columns)
    return replace(recording, streams={**recording.streams, "anchor_ranges": (table,)})


def ranging_grid(recording: Recording, replay: ReplayOptions, margin: float) -> Grid:
    """Steps ``margin`` s after the usual time of a range, so that it arrives fresh but, if it is
    late by less than that, in its own step."""
    dt = replay.dt
    grid = common_grid(recording, dt, ("anchor_ranges",))
    period, time = round(dt * 1e9), recording.streams["anchor_ranges"][0].time
    usual = int(np.median((time - time[0] + period // 2) % period)) - period // 2
    later = (int(time[0]) + usual + round(margin * 1e9) - grid.start) % period
    return replay.cut(Grid(grid.start + later, dt, grid.count - 1))


def anchor_scenario(
    name: str,
    recording: Recording,
    grid: Grid,
    prior: Prior,
    process: Process,
    noise: RangeNoise,
    reward: Reward,
    odometry: Odometry | None = None,
) -> Scenario:
    """One tag with ranges to anchors, and with odometry if there is a belief about it."""
    places = tuple(map(tuple, recording.anchors.tolist()))
    anchors = AnchorRanging(places, noise)
    sensors = [recorded_anchor_ranges(recording, grid, anchors)]
    believed: list[Sensor] = [anchors]
    if odometry is not None:
        sensors.append(recorded_odometry(recording, grid, odometry, _HELD))
        believed.append(odometry)
    return Scenario(
        name=name,
        arena=arena_of(recording, grid, margin=0.5),
        horizon=grid.count - 1,
        motion=recorded_motion(recording, grid),
        sensors=tuple(sensors),
        network=Network(),
        prior=prior,
        process=process,
        believed_sensors=tuple(believed),
        reward=reward,
    )
