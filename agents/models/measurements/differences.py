"""Differences of the distances from a UAV's tags to two anchors."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.models.measurements.base import Block, Measurement, Neighbours, noise_std
from agents.models.measurements.tags import OwnTags
from agents.models.process import Process
from coloc_env.observation import Observation
from coloc_env.sensors import Tdoa
from coloc_env.sensors.base import usable


class RangeDifferences(Measurement):
    """z = ‖t − A_n‖ − ‖t − A_m‖ + noise, t = p + R l an own tag."""

    mask_leaf = "tdoa_mask"

    def __init__(self, sensor: Tdoa) -> None:
        self.variance, self.ends = noise_std(sensor.std) ** 2, sensor.ends
        self.tags, self.depth = OwnTags(sensor.tags), sensor.depth

    def read(
        self, observation: Observation
    ) -> tuple[Float[Tensor, "B N F"], Bool[Tensor, "B N F"]]:
        """Differences (m), and where they were measured."""
        z, mask = usable(observation["tdoa"].unsqueeze(-1), observation[self.mask_leaf] > 0)
        return z[..., 0], mask

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        z, mask = self.read(observation)
        anchors = observation["tdoa_map"].to(x.dtype).unflatten(-1, (-1, process.dim))
        tags, by_turn, spread = self.tags.at(process, x)
        apart = tags.unsqueeze(-2) - anchors.unsqueeze(-3)  # [B, N, T, A, d]
        distance = torch.linalg.vector_norm(apart, dim=-1).clamp_min(1e-9)
        unit, (m, n) = apart / distance.unsqueeze(-1), self.ends
        across = unit[..., n, :] - unit[..., m, :]  # ∂h/∂t = u_n − u_m
        expected = (distance[..., n] - distance[..., m]).flatten(-2)
        jacobian = x.new_zeros(0)
        if derivatives:
            jacobian = x.new_zeros(*across.shape[:-1], process.error_size)
            jacobian[..., : process.dim] = across
            if by_turn is not None:
                jacobian[..., process.attitude_error] = across @ by_turn
            jacobian = torch.cat([jacobian.flatten(-3, -2).unsqueeze(-2)] * self.depth, -3)
        variance = self.variance + spread * across.square().sum(-1).flatten(-2)
        return Block(
            residual=(z.to(x.dtype) - torch.cat([expected] * self.depth, -1)).unsqueeze(-1),
            jacobian=jacobian,
            variance=torch.cat([variance] * self.depth, -1).unsqueeze(-1),
            mask=mask,
        )
