"""Measurements that are linear in position or velocity: landmark vectors, fixes, heights,
slowness."""

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.measurements.base import Block, Measurement, Neighbours
from agents.models.process import Process
from coloc_env.geometry import cross_matrix
from coloc_env.observation import Observation
from coloc_env.sensors import Height, Landmarks, PositionFix, SlowFlight


class LandmarkVectors(Measurement):
    """z = Rᵀ(L − p) + noise for known landmarks."""

    mask_leaf = "landmark_mask"

    def __init__(self, sensor: Landmarks) -> None:
        self.std = sensor.std

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        d = process.dim
        rotation, turn = process.rotation(x), process.attitude_error
        if rotation is None or turn is None:
            raise ValueError(
                "landmark vectors are in the body frame: the motion model has no attitude"
            )
        z = observation["landmarks"].to(x.dtype).unflatten(-1, (-1, d))
        apart = observation["landmark_map"].to(x.dtype).unflatten(-1, (-1, d)) - x[..., None, :d]
        expected = apart @ rotation
        residual = z - expected
        jacobian = x.new_zeros(0)
        if derivatives:
            jacobian = x.new_zeros(*residual.shape, process.error_size)
            jacobian[..., :d] = -rotation.mT.unsqueeze(-3)
            if d == 3:
                jacobian[..., turn] = cross_matrix(expected)
            else:
                jacobian[..., turn] = torch.stack((expected[..., 1:], -expected[..., :1]), -2)
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=x.new_tensor(self.std**2).expand_as(residual),
            mask=observation["landmark_mask"] > 0,
        )


class PositionFixes(Measurement):
    """z = p + noise."""

    mask_leaf = "position_fix_mask"

    def __init__(self, sensor: PositionFix) -> None:
        self.variance = sensor.std**2

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        d = process.dim
        residual = observation["position_fix"].to(x.dtype).unsqueeze(-2) - x[..., None, :d]
        jacobian = x.new_zeros(*residual.shape, process.error_size)
        jacobian[..., :d] = torch.eye(d, dtype=x.dtype, device=x.device)
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=x.new_tensor(self.variance).expand_as(residual),
            mask=observation["position_fix_mask"] > 0,
        )


class Heights(Measurement):
    """z of the position."""

    mask_leaf = "height_mask"

    def __init__(self, sensor: Height) -> None:
        self.variance = sensor.std**2

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        z = observation["height"].to(x.dtype).unsqueeze(-1)
        residual = z - x[..., None, 2:3]
        jacobian = x.new_zeros(*residual.shape, process.error_size)
        jacobian[..., 2] = 1.0
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=x.new_tensor(self.variance).expand_as(residual),
            mask=observation["height_mask"] > 0,
        )


class Slowness(Measurement):
    """Velocity about zero."""

    def __init__(self, sensor: SlowFlight) -> None:
        self.variance = sensor.std**2

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        d = process.dim
        residual = -x[..., None, d : 2 * d]
        jacobian = x.new_zeros(*residual.shape, process.error_size)
        jacobian[..., d : 2 * d] = torch.eye(d, dtype=x.dtype, device=x.device)
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=x.new_tensor(self.variance).expand_as(residual),
            mask=torch.ones(residual.shape[:-1], dtype=torch.bool, device=x.device),
        )
