"""``replay-v0``: a recording of one's own, in the open format."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

import numpy as np

from coloc_env.datasets import Recording
from coloc_env.datasets.carried import (
    believed_tdoa,
    recorded_angles,
    recorded_flow,
    recorded_tdoa,
)
from coloc_env.datasets.corrections import corrected
from coloc_env.datasets.folders import Version, expanded, version
from coloc_env.datasets.grid import Grid, Usual, aligned, common_grid, usual
from coloc_env.datasets.noise_model import NoiseModel, read_noise_model
from coloc_env.datasets.open_format import FILE, read_recording
from coloc_env.datasets.recording import DataError
from coloc_env.datasets.replay import (
    arena_of,
    lever_arms,
    recorded_anchor_ranges,
    recorded_bearings,
    recorded_fixes,
    recorded_height,
    recorded_imu,
    recorded_landmarks,
    recorded_motion,
    recorded_odometry,
    recorded_ranges,
)
from coloc_env.datasets.senses import Read, believed_senses
from coloc_env.datasets.starts import level, spread_of_start
from coloc_env.network import Network
from coloc_env.scenario import (
    ConstantVelocity,
    Inertial,
    Prior,
    PriorOptions,
    Process,
    Reward,
    Scenario,
    Wheeled,
)
from coloc_env.scenarios.parts.replays import OwnReplayOptions
from coloc_env.sensors import (
    AnchorRanging,
    ArrivalAngles,
    Height,
    Imu,
    LandmarkBearings,
    Landmarks,
    Odometry,
    OpticalFlow,
    PositionFix,
    RangeNoise,
    Ranging,
    RecordedSensor,
    Sensor,
    SlowFlight,
    UavBearings,
)

Pair = tuple[RecordedSensor, Sensor]
Make = Callable[[Recording, Grid], Pair]
Drive = Callable[[Recording, Grid, Sequence[Usual] | None], Pair]
_HELD, _USUAL = 1.0, 10.0  # s, usual intervals: for the longer a sample of odometry stands
_UNKNOWN = np.pi / 3**0.5  # rad: standard deviation of an attitude of which nothing is known


def replay_own(
    *,
    path: str | None = None,
    believed: str | None = None,
    process: Literal["auto", "inertial", "wheeled", "constant_velocity"] = "auto",
    reward: Reward = "error",
    replay: OwnReplayOptions = OwnReplayOptions(),
    prior: PriorOptions = PriorOptions(prior_std=0.5),
) -> Scenario:
    """A recording of one's own: the folder ``path`` in the open format. Nothing is simulated but
    the prior's draw.

    ``believed``: the file with what the team believes of its sensors, as ``coloc recording
    calibrate`` writes it (none: the recording's own, or defaults). ``process=auto``: inertial with
    an IMU in space, wheeled with odometry in the plane, else a constant velocity.

    Without ground truth everything runs all the same: the reward is 0 and nothing is scored but at
    marked points. The prior is then about the recording's ``start``, or, where that is not given,
    uniform over an arena around the map.
    """
    if path is None:
        raise ValueError("path=none is not allowed: the folder of a recording is needed")
    folder = expanded(path)
    recording = _read(version(folder), folder)
    model = own_beliefs(recording, folder / FILE, believed)
    recording = corrected(recording, model)
    team = own_team(recording, model, process)
    driver = (team.driver,) if team.driver else ()
    whole = common_grid(recording, replay.dt, driver)
    grid = replay.cut(aligned(whole, recording, tuple(team.sensors)))
    sensors = [make(recording, grid) for make in team.sensors.values()]
    if team.driver:
        sensors.append(team.drive(recording, grid, None))
    beliefs = (*(belief for _, belief in sensors), *team.assumed)
    _name_unused(recording, {*team.sensors, *driver})
    recording = level(recording, grid)
    return Scenario(
        name="replay-v0",
        arena=arena_of(recording, grid, margin=1.0),
        horizon=grid.count - 1,
        motion=recorded_motion(recording, grid),
        sensors=tuple(sensor for sensor, _ in sensors),
        network=Network(),
        prior=own_prior(recording, prior),
        process=team.process,
        believed_sensors=beliefs,
        reward=reward,
    )


@dataclass(frozen=True)
class OwnTeam:
    """How the team of a recording of one's own works: what makes each sensor that corrects an
    estimate on a grid, and the belief about it, by its stream; likewise (``drive``) the sensor that
    drives the motion model (``driver``: its stream, "" for none); what else is assumed."""

    process: Process
    sensors: Mapping[str, Make]
    driver: str
    drive: Drive
    assumed: tuple[Sensor, ...]


def own_team(recording: Recording, model: NoiseModel, process: str = "auto") -> OwnTeam:
    """The team of a recording, by what its streams are and what is believed of them."""
    kind = _kind(recording, model.motion.model if process == "auto" else process)
    settings: Process = ConstantVelocity(model.motion.accel_std, model.motion.damping or None)
    imu, wheels, slow = model.imu, model.odometry, model.motion.slow_flight
    own = Imu(imu.accel_std, imu.gyro_std)
    read = Odometry(wheels.forward_std, wheels.left_std, wheels.turn_std, wheels.relative)

    def inertial(recording: Recording, grid: Grid, like: Sequence[Usual] | None) -> Pair:
        no_bias = np.zeros((len(recording.robots), 6))
        return recorded_imu(recording, grid, own, no_bias, like), own

    def wheeled(recording: Recording, grid: Grid, like: Sequence[Usual] | None) -> Pair:
        return _odometry(recording, grid, read, model, like), read

    driver = {"inertial": "imu", "wheeled": "odometry"}.get(kind, "")
    if kind == "inertial":
        settings = Inertial(imu.accel_bias, imu.gyro_bias, imu.accel_walk, imu.gyro_walk)
    elif kind == "wheeled":
        settings = Wheeled()
    assumed = (SlowFlight(slow),) if slow and kind != "wheeled" else ()
    drive = wheeled if kind == "wheeled" else inertial
    return OwnTeam(settings, _sensors(recording, model), driver, drive, assumed)


def own_beliefs(recording: Recording, setup: Path, believed: str | None) -> NoiseModel:
    """What is believed: as the file ``believed`` says, or else as the ``recording.yaml`` does."""
    if believed is not None:
        return read_noise_model(expanded(believed), recording)
    return read_noise_model(setup, recording, "believed")


def _kind(recording: Recording, wanted: str) -> str:
    """The motion model: as asked for, or by what drives there are."""
    streams, dim = recording.streams, recording.dim

    def whole(stream: str) -> bool:
        return stream in streams and all(len(table.time) for table in streams[stream])

    if wanted == "auto":
        if dim == 3 and whole("imu"):
            return "inertial"
        return "wheeled" if dim == 2 and whole("odometry") else "constant_velocity"
    for kind, stream, needed in (("inertial", "imu", 3), ("wheeled", "odometry", 2)):
        if wanted == kind and (dim != needed or not whole(stream)):
            raise DataError(
                f"{recording.name}: process={kind} needs {stream} of every robot in {needed} "
                "dimensions; process=constant_velocity does without"
            )
    return wanted


def _sensors(recording: Recording, model: NoiseModel) -> dict[str, Make]:
    """What makes, on a grid, each sensor that corrects an estimate and the belief about it, by the
    stream that it is of."""
    makers: dict[str, Make] = {}
    tags = lever_arms(recording) if recording.tags.shape[1] else ()
    if "anchor_ranges" in recording.streams:
        places = tuple(map(tuple, recording.anchors.tolist()))
        anchors = AnchorRanging(places, RangeNoise(std=model.anchor_ranges.std), tags)
        makers["anchor_ranges"] = lambda r, g: (recorded_anchor_ranges(r, g, anchors), anchors)
    if "uav_ranges" in recording.streams:
        ranging = Ranging(RangeNoise(std=model.uav_ranges.std), tags)
        makers["uav_ranges"] = lambda r, g: (recorded_ranges(r, g, ranging), ranging)
    if "landmark_bearings" in recording.streams:
        own = model.landmark_bearings
        seen = LandmarkBearings(len(recording.landmarks), own.range_std, own.bearing_std)
        makers["landmark_bearings"] = lambda r, g: _bearings(r, g, seen)
    if "uav_bearings" in recording.streams:
        met = UavBearings(model.uav_bearings.range_std, model.uav_bearings.bearing_std)
        makers["uav_bearings"] = lambda r, g: _bearings(r, g, met)
    if "landmark_vectors" in recording.streams:
        count, std = len(recording.landmarks), model.landmark_vectors.std
        places = tuple(map(tuple, recording.landmarks.tolist()))
        vectors = Landmarks(count, std, radius=1e4, positions=places)
        makers["landmark_vectors"] = lambda r, g: (recorded_landmarks(r, g, vectors), vectors)
    if "tdoa" in recording.streams:
        tdoa = believed_tdoa(recording, model.tdoa.std, tags)
        makers["tdoa"] = lambda r, g: recorded_tdoa(r, g, tdoa)
    if "arrival_angles" in recording.streams:
        heard = ArrivalAngles(model.arrival_angles.azimuth_std, model.arrival_angles.elevation_std)
        makers["arrival_angles"] = lambda r, g: recorded_angles(r, g, heard)
    if "flow" in recording.streams:
        flow = OpticalFlow(model.flow.std)
        makers["flow"] = lambda r, g: (recorded_flow(r, g, flow), flow)
    if "height" in recording.streams:
        own_height = model.height
        drift = (own_height.drift, own_height.drift_time)
        height = Height(own_height.std, 0.0, *drift, estimated=bool(own_height.drift))
        makers["height"] = lambda r, g: (recorded_height(r, g, height), height)
    if "position_fix" in recording.streams:
        upwards = model.position_fix.vertical_std or None
        fix = PositionFix(model.position_fix.std, len(recording.robots), upwards)
        makers["position_fix"] = lambda r, g: (recorded_fixes(r, g, fix), fix)
    return makers | {
        stream: partial(_sensed, read, sensor)
        for stream, (read, sensor) in believed_senses(recording, model).items()
    }


def _sensed(read: Read, sensor: Sensor, recording: Recording, grid: Grid) -> Pair:
    return read(recording, grid, sensor), sensor


def _bearings(recording: Recording, grid: Grid, sensor: LandmarkBearings | UavBearings) -> Pair:
    found, depth = recorded_bearings(recording, grid, sensor)
    sensor = replace(sensor, depth=depth)
    return replace(found, sensor=sensor), sensor


def _odometry(
    recording: Recording,
    grid: Grid,
    sensor: Odometry,
    model: NoiseModel,
    like: Sequence[Usual] | None,
) -> RecordedSensor:
    wheels = model.odometry
    interval = max(each.interval for each in like or map(usual, recording.streams["odometry"]))
    held = max(_HELD, _USUAL * interval)
    corrections = (wheels.delay, wheels.scale, wheels.turn_scale)
    return recorded_odometry(recording, grid, sensor, held, *corrections, like)


def own_prior(recording: Recording, prior: PriorOptions) -> Prior:
    """As the options say where the start is known; else uniform, and of no known attitude."""
    place, attitude = spread_of_start(recording)
    if not place and prior.prior == "gaussian":
        prior = replace(prior, prior="uniform")
    return prior.at_start(0.2, 0.1 if attitude else _UNKNOWN)


def _name_unused(recording: Recording, used: set[str]) -> None:
    """Say which streams nobody will look at."""
    unused = [name for name in recording.streams if name not in used]
    if unused:
        what = ", ".join(unused)
        warnings.warn(f"{recording.name}: this motion model does not use {what}", stacklevel=4)


@lru_cache(maxsize=4)
def _read(known: Version, folder: Path) -> Recording:
    """A recording, kept for the next scenario that replays it until one of its files changes."""
    return read_recording(folder)
