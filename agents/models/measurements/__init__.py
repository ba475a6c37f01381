"""Measurement models: for each sensor a team believes in, residuals and their Jacobians."""

from collections.abc import Callable
from typing import Any, TypeVar

from agents.errors import NotServed
from agents.models.measurements.angles import UavAngles
from agents.models.measurements.base import (
    Block,
    Measurement,
    Neighbours,
    no_neighbours,
    noise_std,
    per_state,
    received,
)
from agents.models.measurements.bearings import LandmarkRangeBearings, UavRangeBearings
from agents.models.measurements.compass import Headings
from agents.models.measurements.differences import RangeDifferences
from agents.models.measurements.flow import BodyVelocities
from agents.models.measurements.light import Lamps
from agents.models.measurements.magnetic import MappedFields
from agents.models.measurements.ranges import AnchorRanges, UavRanges
from agents.models.measurements.rssi import SignalStrengths, UavStrengths
from agents.models.measurements.ultrasonic import WallDistances
from agents.models.measurements.vectors import Heights, LandmarkVectors, PositionFixes, Slowness
from coloc_env.scenario import (
    Believed,
    ConstantVelocity,
    DisplacementDriven,
    InsDriven,
    Wheeled,
)
from coloc_env.sensors import (
    AnchorRanging,
    ArrivalAngles,
    Compass,
    Height,
    LandmarkBearings,
    Landmarks,
    Light,
    Magnetic,
    OpticalFlow,
    PositionFix,
    Ranging,
    Rssi,
    Sensor,
    SlowFlight,
    Tdoa,
    UavBearings,
    UavRssi,
    Ultrasonic,
    UnlabelledLandmarks,
)
from coloc_env.sensors.base import usable

__all__ = [
    "MODELS",
    "AnchorRanges",
    "Block",
    "BodyVelocities",
    "Headings",
    "Heights",
    "Lamps",
    "LandmarkRangeBearings",
    "LandmarkVectors",
    "MappedFields",
    "Measurement",
    "Neighbours",
    "PositionFixes",
    "RangeDifferences",
    "SignalStrengths",
    "Slowness",
    "UavAngles",
    "UavRangeBearings",
    "UavRanges",
    "UavStrengths",
    "WallDistances",
    "make_measurements",
    "measures",
    "model_of",
    "no_neighbours",
    "noise_std",
    "per_state",
    "received",
    "usable",
]

_M = TypeVar("_M", bound=Callable[[Any], Measurement])

MODELS: dict[type[Sensor], Callable[[Any], Measurement]] = {
    AnchorRanging: AnchorRanges,
    ArrivalAngles: UavAngles,
    Compass: Headings,
    Height: Heights,
    LandmarkBearings: LandmarkRangeBearings,
    Landmarks: LandmarkVectors,
    Light: Lamps,
    Magnetic: MappedFields,
    OpticalFlow: BodyVelocities,
    PositionFix: PositionFixes,
    Ranging: UavRanges,
    Rssi: SignalStrengths,
    SlowFlight: Slowness,
    Tdoa: RangeDifferences,
    UavBearings: UavRangeBearings,
    UavRssi: UavStrengths,
    Ultrasonic: WallDistances,
    UnlabelledLandmarks: LandmarkVectors,
}
_BODY_FRAME = (
    *(ArrivalAngles, Compass, Landmarks, LandmarkBearings, Light, Magnetic, OpticalFlow),
    *(UavBearings, Ultrasonic, UnlabelledLandmarks),
)


def measures(sensor: type[Sensor]) -> Callable[[_M], _M]:
    """Decorator of the measurement model of a sensor of one's own: built from the believed sensor,
    and used from then on by every localizer that uses whatever has a model."""

    def add(model: _M) -> _M:
        MODELS[sensor] = model
        return model

    return add


def make_measurements(believed: Believed) -> list[Measurement]:
    """A model for every believed sensor that measures position, attitude or other UAVs.

    Raises ValueError for a sensor of what the believed motion does not have as a state.
    """
    for sensor in believed.sensors:
        name, process = type(sensor).__name__, believed.process
        level = ConstantVelocity | InsDriven | DisplacementDriven
        if isinstance(sensor, _BODY_FRAME) and isinstance(process, level):
            raise NotServed(f"{name} are in the body frame: the motion model has no attitude")
        if isinstance(sensor, SlowFlight) and isinstance(
            process, Wheeled | InsDriven | DisplacementDriven
        ):
            kind = type(process).__name__
            raise NotServed(f"{name} is about velocity, which {kind} motion does not estimate")
    models = ((model_of(type(sensor)), sensor) for sensor in believed.sensors)
    return [model(sensor) for model, sensor in models if model is not None]


def model_of(sensor: type[Sensor]) -> Callable[[Any], Measurement] | None:
    """The measurement model of a sensor, or of the one it extends; None if there is none."""
    return next((MODELS[kind] for kind in sensor.__mro__ if kind in MODELS), None)
