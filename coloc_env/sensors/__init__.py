"""Sensors: what each UAV measures of the truth."""

from coloc_env.sensors.angles import AngleOptions, ArrivalAngles
from coloc_env.sensors.base import MASK, Layout, Leaf, RecordedSensor, Sensor, Window
from coloc_env.sensors.bearings import LandmarkBearings, UavBearings
from coloc_env.sensors.compass import Compass, CompassOptions
from coloc_env.sensors.displacement import Displacement
from coloc_env.sensors.errors.clock import Clock
from coloc_env.sensors.errors.range_noise import NlosKind, RangeNoise, RangeOptions
from coloc_env.sensors.field_map import FieldMap
from coloc_env.sensors.height import BarometerOptions, Height
from coloc_env.sensors.imu import GRAVITY, Imu, ImuOptions, RecordedImu, SimulatedImuOptions
from coloc_env.sensors.ins import Ins, InsOptions
from coloc_env.sensors.landmark_options import LandmarkOptions
from coloc_env.sensors.landmarks import Landmarks
from coloc_env.sensors.light import Light, LightOptions
from coloc_env.sensors.magnetic import Magnetic, MagneticOptions
from coloc_env.sensors.odometry import Odometry, RecordedOdometry
from coloc_env.sensors.optical_flow import FlowOptions, OpticalFlow
from coloc_env.sensors.position_fix import AnchorUavOptions, GnssOptions, PositionFix
from coloc_env.sensors.ranging import AnchorRanging, Ranging, TagOptions, UavRangeOptions
from coloc_env.sensors.reference import Reference
from coloc_env.sensors.relative_pose import RecordedPoses, RelativePose, RelativePoseOptions
from coloc_env.sensors.rssi import PathLoss, Rssi, RssiOptions, UavRssi
from coloc_env.sensors.sight import Sight, SightOptions
from coloc_env.sensors.slow_flight import SlowFlight
from coloc_env.sensors.tdoa import Tdoa
from coloc_env.sensors.ultrasonic import Ultrasonic, UltrasonicOptions
from coloc_env.sensors.unlabelled_landmarks import UnlabelledLandmarks
from coloc_env.sensors.unmapped import MapOptions, UnmappedLandmarks

__all__ = [
    "GRAVITY",
    "MASK",
    "AnchorRanging",
    "AnchorUavOptions",
    "AngleOptions",
    "ArrivalAngles",
    "BarometerOptions",
    "Clock",
    "Compass",
    "CompassOptions",
    "Displacement",
    "FieldMap",
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
    "Light",
    "LightOptions",
    "Magnetic",
    "MagneticOptions",
    "MapOptions",
    "NlosKind",
    "Odometry",
    "OpticalFlow",
    "PathLoss",
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
    "Rssi",
    "RssiOptions",
    "Sensor",
    "Sight",
    "SightOptions",
    "SimulatedImuOptions",
    "SlowFlight",
    "TagOptions",
    "Tdoa",
    "UavBearings",
    "UavRangeOptions",
    "UavRssi",
    "Ultrasonic",
    "UltrasonicOptions",
    "UnlabelledLandmarks",
    "UnmappedLandmarks",
    "Window",
]
