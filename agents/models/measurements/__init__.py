"""Measurement models: for each sensor a team believes in, residuals and their Jacobians."""

from agents.models.measurements.base import Block, Measurement, Neighbours, heard
from agents.models.measurements.bearings import LandmarkRangeBearings, UavRangeBearings
from agents.models.measurements.ranges import AnchorRanges, UavRanges
from agents.models.measurements.vectors import Heights, LandmarkVectors, Slowness
from coloc_env.scenario import Believed, ConstantVelocity
from coloc_env.sensors import (
    AnchorRanging,
    Height,
    LandmarkBearings,
    Landmarks,
    Ranging,
    SlowFlight,
    UavBearings,
)

__all__ = [
    "AnchorRanges",
    "Block",
    "Heights",
    "LandmarkRangeBearings",
    "LandmarkVectors",
    "Measurement",
    "Neighbours",
    "Slowness",
    "UavRangeBearings",
    "UavRanges",
    "heard",
    "make_measurements",
]

_BODY_FRAME = (Landmarks, LandmarkBearings, UavBearings)


def make_measurements(believed: Believed) -> list[Measurement]:
    """A model for every believed sensor that measures position, attitude or other UAVs."""
    models: list[Measurement] = []
    for sensor in believed.sensors:
        if isinstance(sensor, _BODY_FRAME) and isinstance(believed.process, ConstantVelocity):
            name = type(sensor).__name__
            raise ValueError(f"{name} are in the body frame: the motion model has no attitude")
        if isinstance(sensor, Landmarks):
            models.append(LandmarkVectors(sensor))
        elif isinstance(sensor, AnchorRanging):
            models.append(AnchorRanges(sensor))
        elif isinstance(sensor, Ranging):
            models.append(UavRanges(sensor))
        elif isinstance(sensor, LandmarkBearings):
            models.append(LandmarkRangeBearings(sensor))
        elif isinstance(sensor, UavBearings):
            models.append(UavRangeBearings(sensor))
        elif isinstance(sensor, Height):
            models.append(Heights(sensor))
        elif isinstance(sensor, SlowFlight):
            models.append(Slowness(sensor))
    return models
