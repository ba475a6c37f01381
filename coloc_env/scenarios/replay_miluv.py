"""``replay-miluv-v0``: quadrotors among obstacles and anchors (MILUV)."""

from typing import Literal

import numpy as np

from coloc_env.datasets.grid import common_grid
from coloc_env.datasets.replay import (
    arena_of,
    lever_arms,
    recorded_anchor_ranges,
    recorded_height,
    recorded_imu,
    recorded_motion,
    recorded_ranges,
)
from coloc_env.network import Network
from coloc_env.options import (
    Acceleration,
    AngularRate,
    Metres,
    PositiveSeconds,
    PositiveSpeed,
    WhiteAcceleration,
)
from coloc_env.scenario import ConstantVelocity, Inertial, PriorOptions, Process, Reward, Scenario
from coloc_env.scenarios.parts.replays import BiasOptions, ReplayOptions
from coloc_env.sensors import (
    AnchorRanging,
    Height,
    ImuOptions,
    Ranging,
    Sensor,
    SlowFlight,
)


def replay_miluv(
    *,
    process: Literal["inertial", "constant_velocity"] = "inertial",
    accel_bias: Acceleration = 0.1,
    gyro_bias: AngularRate = 0.005,
    slow_flight: PositiveSpeed = 1.2,
    range_std: Metres = 0.15,
    height_std: Metres = 0.15,
    height_bias_std: Metres = 0.15,
    velocity_accel_std: WhiteAcceleration = 0.6,
    damping: PositiveSeconds | None = 1.0,
    reward: Reward = "error",
    replay: ReplayOptions = ReplayOptions(),
    biases: BiasOptions = BiasOptions(),
    imu: ImuOptions = ImuOptions(accel_std=0.2, gyro_std=0.005),
    prior: PriorOptions = PriorOptions(prior_std=0.5),
) -> Scenario:
    """Three UAVs for 77 s in a room with obstacles (MILUV): IMU, UWB to six anchors and between
    UAVs, laser height. Nothing is simulated but the prior's draw.

    A UAV gets one anchor range a second, with gaps of up to 6.5 s and up to +1.4 m of NLOS bias,
    and nothing else that bounds its horizontal position: strapdown integration alone diverges. The
    team therefore believes that nobody flies fast for long (``slow_flight``, see ``SlowFlight``).
    ``process="constant_velocity"`` leaves the IMU out: velocity driven by ``velocity_accel_std``,
    damped over ``damping`` s; the sequences without IMU need it. The flight is too short to tune on
    one part and score on another: the noise settings were chosen on all of it, and the result is
    flat around them. Biases of ranges are believed to be those of ``replay-hanyang-v0``; heights
    are off by ``height_bias_std`` m, about what they are here (0.11 m RMS over 10 s).
    """
    recording = replay.load("miluv")
    if process == "inertial" and "imu" not in recording.streams:
        raise ValueError(f"{recording.name} has no IMU: process=constant_velocity does without")
    drivers = ("imu",) if process == "inertial" else ()
    grid = replay.cut(common_grid(recording, replay.dt, drivers))
    tags = lever_arms(recording)
    error = biases.noise(range_std)
    anchors = AnchorRanging(tuple(map(tuple, recording.anchors.tolist())), error, tags)
    sensors = [recorded_anchor_ranges(recording, grid, anchors)]
    believed: list[Sensor] = [anchors]
    if "height" in recording.streams:
        height = Height(height_std, bias_std=height_bias_std, bias_time=biases.range_bias_time)
        sensors.append(recorded_height(recording, grid, height))
        believed.append(height)
    if "uav_ranges" in recording.streams:
        uwb = Ranging(error, tags)
        sensors.append(recorded_ranges(recording, grid, uwb))
        believed.append(uwb)
    model: Process = ConstantVelocity(velocity_accel_std, damping)
    if process == "inertial":
        no_bias = np.zeros((len(recording.robots), 6))
        sensors.append(recorded_imu(recording, grid, imu.believed, no_bias))
        believed += [imu.believed, SlowFlight(slow_flight)]
        model = Inertial(accel_bias, gyro_bias, accel_walk=0.01, gyro_walk=1e-4)
    return Scenario(
        name="replay-miluv-v0",
        arena=arena_of(recording, grid, margin=1.0),
        horizon=grid.count - 1,
        motion=recorded_motion(recording, grid),
        sensors=tuple(sensors),
        network=Network(),
        prior=prior.at_start(velocity_std=0.1, attitude_std=0.06),
        process=model,
        believed_sensors=tuple(believed),
        reward=reward,
        tuned_on=("cirObstacles_3_random_0",),
    )
