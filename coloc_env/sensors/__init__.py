"""Sensors: what each UAV measures of the truth."""

from coloc_env.sensors.angles import AngleOptions, ArrivalAngles
from coloc_env.sensors.base import Layout, Leaf, RecordedSensor, Sensor, Window
from coloc_env.sensors.bearings import LandmarkBearings, UavBearings
from coloc_env.sensors.displacement import Displacement
from coloc_env.sensors.errors.clock import Clock
from coloc_env.sensors.errors.range_noise import NlosKind, RangeNoise, RangeOptions
from coloc_env.sensors.height import BarometerOptions, Height
from coloc_env.sensors.imu import GRAVITY, Imu, ImuOptions, RecordedImu, SimulatedImuOptions
from coloc_env.sensors.ins import Ins, InsOptions
from coloc_env.sensors.landmarks import LandmarkOptions, Landmarks
from coloc_env.sensors.odometry import Odometry, RecordedOdometry
from coloc_env.sensors.optical_flow import FlowOptions, OpticalFlow
from coloc_env.sensors.position_fix import AnchorUavOptions, GnssOptions, PositionFix
from coloc_env.sensors.ranging import AnchorRanging, Ranging, TagOptions, UavRangeOptions
from coloc_env.sensors.reference import Reference
from coloc_env.sensors.relative_pose import RecordedPoses, RelativePose, RelativePoseOptions
from coloc_env.sensors.slow_flight import SlowFlight
from coloc_env.sensors.tdoa import Tdoa
from coloc_env.sensors.unlabelled_landmarks import UnlabelledLandmarks

__all__ = [
    "GRAVITY",
    "AnchorRanging",
    "AnchorUavOptions",
    "AngleOptions",
    "ArrivalAngles",
    "BarometerOptions",
    "Clock",
    "Displacement",
    "FlowOptions",
    "GnssOptions",
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
    "OpticalFlow",
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
    "TagOptions",
    "Tdoa",
    "UavBearings",
    "UavRangeOptions",
    "UnlabelledLandmarks",
    "Window",
]
