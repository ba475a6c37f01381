"""Range and bearing in the plane, to landmarks and to other UAVs."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.models.measurements.base import (
    Block,
    Measurement,
    Neighbours,
    believed_biases,
    noise_std,
)
from agents.models.process import Process
from coloc_env.geometry import wrap_angle
from coloc_env.observation import Observation
from coloc_env.sensors import LandmarkBearings, UavBearings
from coloc_env.sensors.base import usable


def _range_bearing(
    process: Process,
    x: Float[Tensor, "B N S"],
    z: Float[Tensor, "B N m 2"],
    points: Float[Tensor, "B N m 2"],
) -> tuple[Float[Tensor, "B N m 2"], Float[Tensor, "B N m 2 E"], Float[Tensor, "B N m 2 2"]]:
    """Residual, own Jacobian, and ∂h/∂point of ranges and bearings to points in the plane."""
    if process.attitude_error is None:
        raise ValueError("bearings are in the body frame: the motion model has no attitude")
    apart = points - x[..., None, :2]
    squared = (apart**2).sum(-1).clamp_min(1e-12)
    distance = squared.sqrt()
    bearing = torch.atan2(apart[..., 1], apart[..., 0]) - process.attitude(x)
    residual = torch.stack((z[..., 0] - distance, wrap_angle(z[..., 1] - bearing)), -1)
    along = apart / distance.unsqueeze(-1)
    across = torch.stack((-apart[..., 1], apart[..., 0]), -1) / squared.unsqueeze(-1)
    by_point = torch.stack((along, across), -2)
    jacobian = x.new_zeros(*residual.shape, process.error_size)
    jacobian[..., :2] = -by_point
    jacobian[..., 1, process.attitude_error] = -1.0
    return residual, jacobian, by_point


class LandmarkRangeBearings(Measurement):
    """Range and bearing to landmarks at known positions."""

    mask_leaf = "landmark_bearing_mask"

    def __init__(self, sensor: LandmarkBearings) -> None:
        self.std = noise_std(sensor.range_std), noise_std(sensor.bearing_std)
        self.depth = sensor.depth
        self.bias_std, self.bias_time = believed_biases(*sensor.bias_std), sensor.bias_time

    def read(
        self, observation: Observation
    ) -> tuple[Float[Tensor, "B N m 2"], Bool[Tensor, "B N m"]]:
        """Range (m) and bearing (rad), and where they were measured."""
        z = observation["landmark_bearings"].unflatten(-1, (-1, 2))
        return usable(z, observation[self.mask_leaf] > 0, ranges=True)

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        z, mask = self.read(observation)
        points = observation["landmark_map"].to(x.dtype).unflatten(-1, (-1, 2))
        points = torch.cat([points] * self.depth, -2)
        residual, jacobian, _ = _range_bearing(process, x, z.to(x.dtype), points)
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=(x.new_tensor(self.std) ** 2).expand_as(residual),
            mask=mask,
        )


class UavRangeBearings(Measurement):
    """Range and bearing to neighbours, whose position is uncertain as ``neighbours`` states."""

    cooperative = True
    mask_leaf = "uav_bearing_mask"

    def __init__(self, sensor: UavBearings) -> None:
        self.std = noise_std(sensor.range_std), noise_std(sensor.bearing_std)
        self.depth = sensor.depth
        self.bias_std, self.bias_time = believed_biases(*sensor.bias_std), sensor.bias_time

    def read(
        self, observation: Observation
    ) -> tuple[Float[Tensor, "B N m 2"], Bool[Tensor, "B N m"]]:
        """Range (m) and bearing (rad), and where they were measured."""
        z = observation["uav_bearings"].unflatten(-1, (-1, 2))
        return usable(z, observation[self.mask_leaf] > 0, ranges=True)

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        z, mask = self.read(observation)
        points = torch.cat([neighbours.position] * self.depth, -2)
        residual, jacobian, by_point = _range_bearing(process, x, z.to(x.dtype), points)
        theirs = torch.cat([neighbours.variance] * self.depth, -2)
        known = torch.cat([neighbours.known] * self.depth, -1)
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=(x.new_tensor(self.std) ** 2).expand_as(residual),
            mask=mask & known,
            partner=by_point,
            partner_variance=(by_point**2 * theirs.unsqueeze(-2)).sum(-1),
        )
