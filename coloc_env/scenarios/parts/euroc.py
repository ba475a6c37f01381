"""Calibration of the IMU of EuRoC's vehicle."""

import numpy as np

from coloc_env.datasets import Recording
from coloc_env.datasets.euroc import room
from coloc_env.datasets.recording import Floats
from coloc_env.scenario import Inertial

# Means of the bias states in the ground truths of two sequences, each in a building of its own: a
# room's sequences are corrected by the one elsewhere, of the same vehicle, so that no segment is
# calibrated on itself. Gyro (rad/s), accelerometer (m/s²), FLU body.
_MH_04 = (0.07665, -0.02107, -0.00214, 0.0595, -0.1371, -0.0273)
_V1_03 = (0.07660, -0.02181, -0.00235, 0.0896, -0.1795, -0.0237)


def euroc_bias(recording: Recording) -> Floats:
    """The IMU's calibrated bias [N, 6] for a team of one room."""
    bias = _V1_03 if room(recording.robots[0]) == "MH" else _MH_04
    return np.tile(bias, (len(recording.robots), 1))


def euroc_process(estimate_bias: bool) -> Inertial:
    """With what is left of the bias as a state, or with none: prior and walk wide enough for what a
    calibration elsewhere cannot know."""
    return Inertial(0.1, 0.003, accel_walk=0.01, gyro_walk=1e-4) if estimate_bias else Inertial()
