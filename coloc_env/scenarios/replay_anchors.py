"""``replay-tuc-v0``, ``replay-hanyang-v0``: recordings of one tag in the plane among anchors."""

from dataclasses import replace
from typing import Literal

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
from coloc_env.scenario import ConstantVelocity, Prior, Process, Scenario, Wheeled
from coloc_env.scenarios.registry import register
from coloc_env.scenarios.replay import cut, loaded
from coloc_env.sensors import AnchorRanging, Odometry, RangeNoise, Sensor


def corrected(recording: Recording, delay: float, bias: float) -> Recording:
    """The recording with its ranges ``delay`` s older than their stamps and ``bias`` m shorter."""
    (ranges,) = recording.streams["anchor_ranges"]
    values = ranges.values - bias * (np.array(ranges.columns) == "range")
    table = Table(ranges.time - round(delay * 1e9), values, ranges.columns)
    return replace(recording, streams={**recording.streams, "anchor_ranges": (table,)})


def ranging_grid(
    recording: Recording, dt: float, span: tuple[float, float] | None, margin: float
) -> Grid:
    """Steps ``margin`` s after the usual time of a range, so that it arrives fresh but, if it is
    late by less than that, in its own step."""
    grid = common_grid(recording, dt, ("anchor_ranges",))
    period, time = round(dt * 1e9), recording.streams["anchor_ranges"][0].time
    usual = int(np.median((time - time[0] + period // 2) % period)) - period // 2
    later = (int(time[0]) + usual + round(margin * 1e9) - grid.start) % period
    return cut(Grid(grid.start + later, dt, grid.count - 1), span)


def anchor_scenario(
    name: str,
    recording: Recording,
    grid: Grid,
    prior: Prior,
    process: Process,
    range_std: float,
    reward: str,
    odometry: Odometry | None = None,
) -> Scenario:
    """One tag with ranges to anchors, and with odometry if there is a belief about it."""
    places = tuple(map(tuple, recording.anchors.tolist()))
    anchors = AnchorRanging(places, RangeNoise(std=range_std))
    sensors = [recorded_anchor_ranges(recording, grid, anchors)]
    believed: list[Sensor] = [anchors]
    if odometry is not None:
        sensors.append(recorded_odometry(recording, grid, odometry, 0.0, 1.0))
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


@register("replay-tuc-v0")
def replay_tuc(
    *,
    sequence: str | None = None,
    data: str | None = None,
    dt: float = 0.128,
    span: tuple[float, float] | None = None,
    reward: str = "error",
    prior_std: float = 0.5,
    prior: str = "gaussian",
    max_speed: float = 0.5,
    process: Literal["wheeled", "constant_velocity"] = "wheeled",
    range_std: float = 0.15,
    range_bias: float = 0.11,
    velocity_accel_std: float = 0.5,
    forward_std: float = 0.05,
    turn_std: float = 0.2,
) -> Scenario:
    """A wheeled robot for 30 s in a square of 2.4 m among four anchors (TU Chemnitz "Labyrinth"):
    odometry and one range a step. Nothing is simulated but the prior's draw.

    ``process="constant_velocity"`` leaves the odometry out: velocity driven by
    ``velocity_accel_std``. ``range_bias`` (m) is taken off every range. It and the noise settings
    were chosen on the first 15 s. On the rest the EKF is off by 0.099 m RMS (Huber 0.090), without
    odometry by 0.150 (0.144), without taking the bias off by 0.189 and 0.241. Stamps drift against
    the steps: from 23 s on a range is delivered 0.08 s, from 25 s on 0.05 s after it was measured,
    and a few of the last steps have no truth near enough to be scored.
    """
    recording = corrected(loaded("tuc", sequence, data), 0.0, range_bias)
    grid = ranging_grid(recording, dt, span, margin=0.001)
    model: Process = ConstantVelocity(velocity_accel_std)
    odometry = None
    if process == "wheeled":
        model, odometry = Wheeled(), Odometry(forward_std, 0.5 * forward_std, turn_std)
    told = Prior(prior_std, 0.1, 0.2, prior, max_speed if prior == "uniform" else None)
    return anchor_scenario(
        "replay-tuc-v0", recording, grid, told, model, range_std, reward, odometry
    )


@register("replay-hanyang-v0")
def replay_hanyang(
    *,
    sequence: str | None = None,
    data: str | None = None,
    dt: float = 0.1,
    span: tuple[float, float] | None = None,
    reward: str = "error",
    prior_std: float = 1.0,
    prior: str = "gaussian",
    max_speed: float = 1.5,
    range_delay: float = 0.18,
    range_std: float = 0.2,
    velocity_accel_std: float = 0.5,
) -> Scenario:
    """A tag on the ground for 3 to 5 min, up to 50 m from four anchors within 5 m of each other
    (Hanyang University): ranges, one in 200 too short by 1 to 19 m. Nothing is simulated but the
    prior's draw.

    Ranges are taken to be ``range_delay`` s older than their stamps, and delivered at once: a step
    has those of the last 0.1 s by that clock (0 uses them as they are stamped). The noise settings
    were chosen on LOS/Trajectory_B/Case_3, the delay is the same in all cases. On the others the
    Huber EKF is off by 0.80, 0.79 and 0.40 m RMS (LOS A, NLOS A, NLOS B), the plain EKF, which
    believes every range, by 1.9, 6.7 and 2.0. Every fifth step has no truth within 50 ms and is not
    scored.
    """
    if range_delay < 0:
        raise ValueError("range_delay is a time in s ≥ 0")
    recording = corrected(loaded("hanyang", sequence, data), range_delay, 0.0)
    grid = ranging_grid(recording, dt, span, margin=0.04)
    told = Prior(prior_std, 0.1, 0.2, prior, max_speed if prior == "uniform" else None)
    model = ConstantVelocity(velocity_accel_std)
    return anchor_scenario("replay-hanyang-v0", recording, grid, told, model, range_std, reward)
