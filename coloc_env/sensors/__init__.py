"""Sensors: what each UAV measures of the truth."""

from coloc_env.sensors.base import Layout, Leaf, RecordedSensor, Sensor, Window
from coloc_env.sensors.bearings import LandmarkBearings, UavBearings
from coloc_env.sensors.displacement import Displacement
from coloc_env.sensors.errors.clock import Clock
from coloc_env.sensors.errors.range_noise import NlosKind, RangeNoise, RangeOptions
from coloc_env.sensors.height import Height
from coloc_env.sensors.imu import GRAVITY, Imu, ImuOptions, RecordedImu, SimulatedImuOptions
from coloc_env.sensors.ins import Ins, InsOptions
from coloc_env.sensors.landmarks import LandmarkOptions, Landmarks
from coloc_env.sensors.odometry import Odometry, RecordedOdometry
from coloc_env.sensors.position_fix import AnchorUavOptions, PositionFix
from coloc_env.sensors.ranging import AnchorRanging, Ranging, UavRangeOptions
from coloc_env.sensors.reference import Reference
from coloc_env.sensors.relative_pose import RecordedPoses, RelativePose, RelativePoseOptions
from coloc_env.sensors.slow_flight import SlowFlight

__all__ = [
    "GRAVITY",
    "AnchorRanging",
    "AnchorUavOptions",
    "Clock",
    "Displacement",
    "Height",
    "Imu",
    "ImuOptions",
    "Ins",
    "InsOptions",
    "LandmarkBearings",
    "LandmarkOptions",
    "Landmarks",
    "Layout",
    "Leaf",
    "NlosKind",
    "Odometry",
    "PositionFix",
    "RangeNoise",
    "RangeOptions",
    "Ranging",
    "RecordedImu",
    "RecordedOdometry",
    "RecordedPoses",
    "RecordedSensor",
    "Reference",
    "RelativePose",
    "RelativePoseOptions",
    "Sensor",
    "SimulatedImuOptions",
    "SlowFlight",
    "UavBearings",
    "UavRangeOptions",
    "Window",
]
