"""Sensors: what each UAV measures of the truth."""

from coloc_env.sensors.base import Layout, Leaf, Recorded, Sensor, Window
from coloc_env.sensors.bearings import LandmarkBearings, UavBearings
from coloc_env.sensors.errors.clock import Clock
from coloc_env.sensors.errors.range_noise import RangeNoise
from coloc_env.sensors.height import Height
from coloc_env.sensors.imu import GRAVITY, Imu, RecordedImu
from coloc_env.sensors.ins import Ins
from coloc_env.sensors.landmarks import Landmarks
from coloc_env.sensors.odometry import Odometry
from coloc_env.sensors.position_fix import PositionFix
from coloc_env.sensors.ranging import AnchorRanging, Ranging
from coloc_env.sensors.reference import Reference
from coloc_env.sensors.relative_pose import RecordedPoses, RelativePose
from coloc_env.sensors.slow_flight import SlowFlight

__all__ = [
    "GRAVITY",
    "AnchorRanging",
    "Clock",
    "Height",
    "Imu",
    "Ins",
    "LandmarkBearings",
    "Landmarks",
    "Layout",
    "Leaf",
    "Odometry",
    "PositionFix",
    "RangeNoise",
    "Ranging",
    "Recorded",
    "RecordedImu",
    "RecordedPoses",
    "Reference",
    "RelativePose",
    "Sensor",
    "SlowFlight",
    "UavBearings",
    "Window",
]
