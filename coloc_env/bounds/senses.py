"""Fisher information of compass, lamps, signal strength, ultrasound and magnetic field about a
UAV's own pose, registered with ``information``.

Hᵀ R⁻¹ H as there, H by the very functions that the sensors measure with; masks say what arrived.
What is behind a wall stays there however the truth is moved, and the error of a magnetic map counts
as known: no estimator knows more.
"""

import math

import torch
from jaxtyping import Float64
from torch import Tensor

from coloc_env.bounds.information import (
    between,
    gram,
    own_information,
    seen_of_others,
    shared_information,
)
from coloc_env.bounds.mixture import EXACT
from coloc_env.geometry import rotation_matrix
from coloc_env.motion import Kinematics
from coloc_env.observation import Observation
from coloc_env.sensors import Compass, Light, Magnetic, Rssi, UavRssi, Ultrasonic
from coloc_env.sensors.compass import heading


@own_information.register
def _compass(sensor: Compass, truth: Kinematics, seen: Observation) -> Float64[Tensor, "B N D D"]:
    """z = ψ(R) + N(0, σ²)."""
    _, by_turn = heading(rotation_matrix(truth.attitude))
    rows = torch.cat((torch.zeros_like(truth.position), by_turn), -1).unsqueeze(-2)
    return gram(rows.unsqueeze(-2), seen["compass_mask"].double() / max(sensor.std, EXACT) ** 2)


@own_information.register
def _rssi(sensor: Rssi, truth: Kinematics, seen: Observation) -> Float64[Tensor, "B N D D"]:
    """z = P₀ − 10 n log₁₀ ‖p − A‖ − losses + N(0, σ²)."""
    d = truth.position.shape[-1]
    points = seen["rssi_map"].double().unflatten(-1, (-1, d))
    _, gradient = sensor.loss.expected(truth.position.unsqueeze(-2), points)
    rows = torch.nn.functional.pad(gradient, (0, 3 if d == 3 else 1))
    return gram(rows.unsqueeze(-2), seen["rssi_mask"].double() / max(sensor.loss.std, EXACT) ** 2)


@shared_information.register
def _uav_rssi(
    sensor: UavRssi, truth: Kinematics, seen: Observation
) -> Float64[Tensor, "B N D N D"]:
    """The same of other UAVs, each end measuring for itself."""
    d, n = truth.position.shape[-1], truth.position.shape[1]
    others = truth.position.unsqueeze(1).expand(-1, n, -1, -1)
    _, gradient = sensor.loss.expected(truth.position.unsqueeze(-2), others)
    rows = torch.nn.functional.pad(gradient, (0, 3 if d == 3 else 1)).unsqueeze(-2)
    weights = seen_of_others(seen, "uav_rssi_mask", 1) / max(sensor.loss.std, EXACT) ** 2
    return between(rows, weights)


@own_information.register
def _ultrasonic(
    sensor: Ultrasonic, truth: Kinematics, seen: Observation
) -> Float64[Tensor, "B N D D"]:
    """z = t(p, R) + N(0, σ²)."""
    _, rows = sensor.expected(truth.position, rotation_matrix(truth.attitude))
    return gram(rows.unsqueeze(-2), seen["ultrasonic_mask"].double() / max(sensor.std, EXACT) ** 2)


@own_information.register
def _magnetic(sensor: Magnetic, truth: Kinematics, seen: Observation) -> Float64[Tensor, "B N D D"]:
    """z = Rᵀ B(p) + N(0, σ² I)."""
    rotation = rotation_matrix(truth.attitude)
    rows = sensor.in_body_by_pose(*sensor.field(truth.position), rotation)
    return gram(rows.unsqueeze(2), seen["magnetic_mask"].double() / max(sensor.std, EXACT) ** 2)


@own_information.register
def _light(sensor: Light, truth: Kinematics, seen: Observation) -> Float64[Tensor, "B N D D"]:
    """Intensities N(I, s²) with s² = (ε I)² + f², which have 1 / s² + 2 (ds/dI / s)² about I (Kay
    1993, eq. 3.31); directions of von Mises and Fisher, which have κ (coth κ − 1/κ) across."""
    there = seen["light_mask"].double()
    lamps = seen["light_map"].double().unflatten(-1, (-1, 3))
    apart = lamps - truth.position.unsqueeze(-2)
    intensity, gradient = sensor.intensity(apart)
    variance = sensor.variance(intensity).clamp_min(EXACT**2)
    by_size = 1 / variance + 2 * (sensor.share**2 * intensity / variance) ** 2
    bright = gram(torch.nn.functional.pad(-gradient, (0, 3)).unsqueeze(-2), there * by_size)
    rows = sensor.direction_by_pose(apart, rotation_matrix(truth.attitude))
    kappa = 1 / sensor.angle_std**2
    across = kappa * (1 / math.tanh(kappa) - 1 / kappa)
    return bright + gram(rows, across * there)
