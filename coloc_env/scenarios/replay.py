"""``replay-…-v0``: real recordings through the same world, faces and localizers.

The data are their owners' and not part of this package: see ``coloc_env.datasets``. Loading is lazy
(at ``make_scenario``) and parsing is cached on disk.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from coloc_env.datasets import Recording, load
from coloc_env.datasets.euroc import room
from coloc_env.datasets.grid import Grid, common_grid
from coloc_env.datasets.recording import Floats
from coloc_env.datasets.replay import (
    arena_of,
    lever_arms,
    recorded_anchor_ranges,
    recorded_bearings,
    recorded_height,
    recorded_imu,
    recorded_motion,
    recorded_odometry,
    recorded_ranges,
)
from coloc_env.network import Network
from coloc_env.scenario import ConstantVelocity, Inertial, Prior, Process, Scenario, Wheeled
from coloc_env.scenarios.registry import register
from coloc_env.sensors import (
    AnchorRanging,
    Height,
    Imu,
    LandmarkBearings,
    Landmarks,
    Odometry,
    RangeNoise,
    Ranging,
    Sensor,
    SlowFlight,
    UavBearings,
)

# Means of the bias states that the ground truths of two flights carry, each in a building of its
# own: a room's flights are corrected by the one elsewhere, of the same vehicle, so that no segment
# is calibrated on itself. Gyro (rad/s), accelerometer (m/s²), FLU body.
_MH_04 = (0.07665, -0.02107, -0.00214, 0.0595, -0.1371, -0.0273)
_V1_03 = (0.07660, -0.02181, -0.00235, 0.0896, -0.1795, -0.0237)


def euroc_bias(recording: Recording) -> Floats:
    """The IMU's calibrated bias [N, 6] for a team of one room."""
    bias = _V1_03 if room(recording.robots[0]) == "MH" else _MH_04
    return np.tile(bias, (len(recording.robots), 1))


# What is left of the bias: prior and walk wide enough for what a calibration flight cannot know.
LEFT_OVER = Inertial(0.1, 0.003, accel_walk=0.01, gyro_walk=1e-4)


def cut(grid: Grid, span: tuple[float, float] | None) -> Grid:
    """The part of a recording from ``span[0]`` to ``span[1]`` s after its common start."""
    if span is None:
        return grid
    first, last = (round(s / grid.dt) for s in span)
    last = min(last, grid.count - 1)
    if not 0 <= first < last:
        raise ValueError(
            f"span={span} is not allowed: (from, to) in s within 0 and {grid.count * grid.dt:.1f}"
        )
    return Grid(int(grid.times[first]), grid.dt, last - first + 1)


@lru_cache(maxsize=4)
def loaded(name: str, sequence: str | None, data: str | None, **options: Any) -> Recording:
    """A recording, kept for the next scenario made of it."""
    return load(name, sequence, data, **options)


@register("replay-mrclam-v0")
def replay_mrclam(
    *,
    sequence: str | None = None,
    data: str | None = None,
    dt: float = 0.1,
    span: tuple[float, float] | None = None,
    reward: str = "error",
    prior_std: float = 0.1,
    forward_std: float = 0.03,
    turn_std: float = 0.1,
    odometry_relative: float = 0.2,
    odometry_delay: float = 0.0,
    odometry_scale: float = 1.0,
    range_std: float = 0.2,
    bearing_std: float = 0.04,
) -> Scenario:
    """Five ground robots for 756 s: odometry, range and bearing to 15 landmarks and to each other
    (UTIAS MRCLAM). Nothing is simulated but the prior's draw.

    Odometry is the commanded velocity, used as it is; ``odometry_delay=0.25`` (s) and
    ``odometry_scale=0.93`` correct what the first 250 s show of it. The noise settings are the
    team's belief, chosen on those 250 s.
    """
    if odometry_delay < 0 or odometry_scale <= 0:
        raise ValueError("odometry_delay is a time in s ≥ 0, odometry_scale a factor > 0")
    recording = loaded("mrclam", sequence, data)
    grid = cut(common_grid(recording, dt, ("odometry",)), span)
    odometry = Odometry(forward_std, 0.5 * forward_std, turn_std, odometry_relative)
    landmarks = LandmarkBearings(len(recording.landmarks), range_std, bearing_std)
    robots = UavBearings(range_std, bearing_std)
    seen, depth = recorded_bearings(recording, grid, landmarks)
    landmarks = replace(landmarks, depth=depth)
    met, depth = recorded_bearings(recording, grid, robots)
    robots = replace(robots, depth=depth)
    return Scenario(
        name="replay-mrclam-v0",
        arena=arena_of(recording, grid, margin=1.0),
        horizon=grid.count - 1,
        motion=recorded_motion(recording, grid),
        sensors=(
            recorded_odometry(recording, grid, odometry, odometry_delay, odometry_scale),
            replace(seen, sensor=landmarks),
            replace(met, sensor=robots),
        ),
        network=Network(),
        prior=Prior(position_std=prior_std, velocity_std=0.05, attitude_std=0.05),
        process=Wheeled(),
        believed_sensors=(odometry, landmarks, robots),
        reward=reward,
    )


@register("replay-euroc-v0")
def replay_euroc(
    *,
    sequence: str | None = None,
    data: str | None = None,
    dt: float = 0.1,
    span: tuple[float, float] | None = None,
    reward: str = "error",
    prior_std: float = 2.0,
    prior: str = "gaussian",
    landmarks: int = 20,
    landmark_std: float = 0.15,
    landmark_radius: float = 10.0,
    false_matches: float = 0.0,
    landmark_dropout: float = 0.0,
    range_only: tuple[float, float] | None = None,
    uwb_std: float = 0.2,
    nlos: float = 0.0,
    nlos_bias: float = 1.0,
    accel_std: float = 0.05,
    gyro_std: float = 0.003,
    estimate_bias: bool = True,
) -> Scenario:
    """Three real flights of one vehicle in one room "together" (EuRoC V1): IMU, biases and motion
    are real, UWB and landmarks simulated as in ``indoor-v0``.

    The IMU's bias is calibrated on a flight in another room (MH_04, for the MH flights V1_03), what
    is left of it is estimated unless ``estimate_bias=false``.
    """
    if landmarks < 0:
        raise ValueError(f"landmarks={landmarks} is not allowed: a count ≥ 0")
    recording = loaded("euroc", sequence, data)
    grid = cut(common_grid(recording, dt, ("imu",)), span)
    imu = Imu(accel_std, gyro_std)
    uwb = Ranging(RangeNoise(std=uwb_std, nlos=nlos, nlos_bias=nlos_bias))
    sensors = [recorded_imu(recording, grid, imu, euroc_bias(recording)), uwb]
    believed = [imu, Ranging(RangeNoise(std=uwb_std))]
    if landmarks:
        sensors.append(
            Landmarks(
                landmarks,
                landmark_std,
                landmark_radius,
                false_matches,
                landmark_dropout,
                range_only,
            )
        )
        believed.append(Landmarks(landmarks, landmark_std, landmark_radius))
    process = LEFT_OVER if estimate_bias else Inertial()
    return Scenario(
        name="replay-euroc-v0",
        arena=arena_of(recording, grid, margin=1.5),
        horizon=grid.count - 1,
        motion=recorded_motion(recording, grid),
        sensors=tuple(sensors),
        network=Network(),
        prior=Prior(position_std=prior_std, kind=prior),
        process=process,
        believed_sensors=tuple(believed),
        reward=reward,
    )


@register("replay-miluv-v0")
def replay_miluv(
    *,
    sequence: str | None = None,
    data: str | None = None,
    dt: float = 0.1,
    span: tuple[float, float] | None = None,
    reward: str = "error",
    prior_std: float = 0.5,
    process: Literal["inertial", "constant_velocity"] = "inertial",
    accel_std: float = 0.2,
    gyro_std: float = 0.005,
    accel_bias: float = 0.1,
    gyro_bias: float = 0.005,
    slow_flight: float = 1.2,
    range_std: float = 0.15,
    height_std: float = 0.15,
    velocity_accel_std: float = 0.6,
    damping: float | None = 1.0,
) -> Scenario:
    """Three UAVs for 77 s in a room with obstacles (MILUV): IMU, UWB to six anchors and between
    UAVs, laser height. Nothing is simulated but the prior's draw.

    A UAV gets one anchor range a second, with gaps of up to 6.5 s and up to +1.4 m of NLOS bias,
    and nothing else that bounds its horizontal position: strapdown integration alone diverges. The
    team therefore believes that nobody flies fast for long (``slow_flight``, see ``SlowFlight``).
    ``process="constant_velocity"`` leaves the IMU out: velocity driven by ``velocity_accel_std``,
    damped over ``damping`` s; the sequences without IMU need it. The flight is too short to tune on
    one part and score on another: the noise settings were chosen on all of it, and the result is
    flat around them.
    """
    recording = loaded("miluv", sequence, data)
    if process == "inertial" and "imu" not in recording.streams:
        raise ValueError(f"{recording.name} has no IMU: process=constant_velocity does without")
    drivers = ("imu",) if process == "inertial" else ()
    grid = cut(common_grid(recording, dt, drivers), span)
    tags = lever_arms(recording)
    error = RangeNoise(std=range_std)
    anchors = AnchorRanging(tuple(map(tuple, recording.anchors.tolist())), error, tags)
    height = Height(height_std)
    sensors = [
        recorded_anchor_ranges(recording, grid, anchors),
        recorded_height(recording, grid, height),
    ]
    believed: list[Sensor] = [anchors, height]
    if "uav_ranges" in recording.streams:
        uwb = Ranging(error, tags)
        sensors.append(recorded_ranges(recording, grid, uwb))
        believed.append(uwb)
    model: Process = ConstantVelocity(velocity_accel_std, damping)
    if process == "inertial":
        imu = Imu(accel_std, gyro_std)
        sensors.append(recorded_imu(recording, grid, imu, np.zeros((len(recording.robots), 6))))
        believed += [imu, SlowFlight(slow_flight)]
        model = Inertial(accel_bias, gyro_bias, accel_walk=0.01, gyro_walk=1e-4)
    return Scenario(
        name="replay-miluv-v0",
        arena=arena_of(recording, grid, margin=1.0),
        horizon=grid.count - 1,
        motion=recorded_motion(recording, grid),
        sensors=tuple(sensors),
        network=Network(),
        prior=Prior(position_std=prior_std, velocity_std=0.1, attitude_std=0.06),
        process=model,
        believed_sensors=tuple(believed),
        reward=reward,
    )
