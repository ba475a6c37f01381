"""Received signal strength of access points."""

import math

from jaxtyping import Float
from torch import Tensor

from agents.models.measurements.base import Block, Measurement, Neighbours, noise_std
from agents.models.process import Process
from coloc_env.observation import Observation
from coloc_env.sensors import Rssi
from coloc_env.sensors.base import usable

_BEND = math.sqrt(3)  # ‖d² ∂² ln d / ∂p²‖: eigenvalues −1, 1 and 1


class SignalStrengths(Measurement):
    """z = P₀ − 10 n log₁₀ ‖p − A‖ − losses in known walls + noise, in dB."""

    mask_leaf = "rssi_mask"

    def __init__(self, sensor: Rssi) -> None:
        self.sensor, self.variance = sensor, noise_std(sensor.std) ** 2

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        d = process.dim
        z, mask = usable(observation["rssi"].unsqueeze(-1), observation[self.mask_leaf] > 0)
        points = observation["rssi_map"].to(x.dtype).unflatten(-1, (-1, d))
        expected, gradient = self.sensor.expected(x[..., None, :d], points)
        residual = z.to(x.dtype) - expected.unsqueeze(-1)
        jacobian, curvature = x.new_zeros(0), None
        if derivatives:
            jacobian = x.new_zeros(*residual.shape, process.error_size)
            jacobian[..., 0, :d] = gradient
            slope = 10 * self.sensor.exponent / math.log(10)
            curvature = _BEND / slope * gradient.square().sum(-1, keepdim=True)  # of slope / d²
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=x.new_tensor(self.variance).expand_as(residual),
            mask=mask,
            curvature=curvature,
        )
