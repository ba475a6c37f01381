"""Received signal strength of access points and of other UAVs."""

import math
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from agents.models.measurements.base import Block, Measurement, Neighbours, noise_std
from agents.models.process import Process
from coloc_env.observation import Observation
from coloc_env.sensors import Rssi, UavRssi
from coloc_env.sensors.base import usable

_BEND = math.sqrt(3)  # ‖d² ∂² ln d / ∂p²‖: eigenvalues −1, 1 and 1


class _Strengths(Measurement):
    """z = P₀ − 10 n log₁₀ ‖p − A‖ − losses in known walls + noise, in dB."""

    leaf: str

    def __init__(self, sensor: Rssi | UavRssi) -> None:
        self.loss, self.variance = sensor.loss, noise_std(sensor.loss.std) ** 2

    def _block(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        points: Float[Tensor, "B N m d"],
        derivatives: bool,
    ) -> tuple[Block, Float[Tensor, "B N m 1 d"]]:
        """The block of all points, and the derivatives by the own position."""
        assert self.mask_leaf is not None
        z, mask = usable(observation[self.leaf].unsqueeze(-1), observation[self.mask_leaf] > 0)
        d = process.dim
        expected, gradient = self.loss.expected(x[..., None, :d], points.to(x.dtype))
        residual, by_place = z.to(x.dtype) - expected.unsqueeze(-1), gradient.unsqueeze(-2)
        jacobian, curvature = x.new_zeros(0), None
        if derivatives:
            jacobian = x.new_zeros(*residual.shape, process.error_size)
            jacobian[..., :d] = by_place
            curvature = _BEND / self.loss.slope * by_place.square().sum(-1)  # of slope / d²
        variance = x.new_tensor(self.variance).expand_as(residual)
        return Block(residual, jacobian, variance, mask, curvature=curvature), by_place


class SignalStrengths(_Strengths):
    """Of access points at known places."""

    leaf, mask_leaf = "rssi", "rssi_mask"

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        points = observation["rssi_map"].unflatten(-1, (-1, process.dim))
        return self._block(process, x, observation, points, derivatives)[0]


class UavStrengths(_Strengths):
    """Of neighbours, whose position is uncertain as ``neighbours`` states."""

    cooperative = True
    leaf, mask_leaf = "uav_rssi", "uav_rssi_mask"

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        points = neighbours.position
        block, by_place = self._block(process, x, observation, points, derivatives)
        return replace(
            block,
            mask=block.mask & neighbours.known,
            partner=-by_place,
            partner_variance=(by_place**2 * neighbours.variance.unsqueeze(-2)).sum(-1),
        )
