"""Azimuth and elevation of other UAVs, in the body frame."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.models.measurements.base import Block, Measurement, Neighbours, body_frame, noise_std
from agents.models.process import Process
from coloc_env.geometry import cross_matrix, wrap_angle
from coloc_env.observation import Observation
from coloc_env.sensors import ArrivalAngles
from coloc_env.sensors.angles import angles_by_vector, azimuth_elevation
from coloc_env.sensors.base import usable


class UavAngles(Measurement):
    """Directions v = Rᵀ(p_j − p) to neighbours, whose position is uncertain as ``neighbours``
    states."""

    cooperative = True
    mask_leaf = "arrival_angle_mask"

    def __init__(self, sensor: ArrivalAngles) -> None:
        self.std = noise_std(sensor.azimuth_std), noise_std(sensor.elevation_std)
        self.depth = sensor.depth

    def read(
        self, observation: Observation
    ) -> tuple[Float[Tensor, "B N m 2"], Bool[Tensor, "B N m"]]:
        """Azimuth and elevation (rad), and where they were measured."""
        z = observation["arrival_angles"].unflatten(-1, (-1, 2))
        return usable(z, observation[self.mask_leaf] > 0)

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        rotation, turn = body_frame(process, x, "angles are")
        z, mask = self.read(observation)
        points = torch.cat([neighbours.position] * self.depth, -2).to(x.dtype)
        theirs = torch.cat([neighbours.variance] * self.depth, -2)
        known = torch.cat([neighbours.known] * self.depth, -1)
        apart = (points - x[..., None, :3]) @ rotation  # v = Rᵀ(p_j − p)
        azimuth, elevation = (z.to(x.dtype) - azimuth_elevation(apart)).unbind(-1)
        residual = torch.stack((wrap_angle(azimuth), elevation), -1)
        by_vector = angles_by_vector(apart)  # [B, N, m, 2, 3]
        by_point = by_vector @ rotation.mT.unsqueeze(-3)
        jacobian = x.new_zeros(0)
        if derivatives:
            jacobian = x.new_zeros(*residual.shape, process.error_size)
            jacobian[..., :3] = -by_point
            jacobian[..., turn] = by_vector @ cross_matrix(apart)  # ∂v/∂δθ = [v]×
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=(x.new_tensor(self.std) ** 2).expand_as(residual),
            mask=mask & known,
            partner=by_point,
            partner_variance=(by_point**2 * theirs.unsqueeze(-2)).sum(-1),
        )
