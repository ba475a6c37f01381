"""Intensities of lamps, and directions to them."""

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.measurements.base import Block, Measurement, Neighbours, body_frame, noise_std
from agents.models.process import Process
from coloc_env.observation import Observation
from coloc_env.sensors import Light
from coloc_env.sensors.base import usable

_INTENSITY, _DIRECTION = 54**0.5, 2.0  # ‖∂² f / ∂v²‖ r² / f right below the lamp; at most


class Lamps(Measurement):
    """For each lamp (I, u) = (I(v), Rᵀ v / r) + noise, v = L − p, r = ‖v‖. A direction's squared
    residual over σ² is 2 κ (1 − z·u), which makes its likelihood that of von Mises and Fisher."""

    mask_leaf = "light_mask"

    def __init__(self, sensor: Light) -> None:
        self.sensor, self.angle_variance = sensor, noise_std(sensor.angle_std) ** 2

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        rotation, turn = body_frame(process, x, "directions of lamps are")
        measured = observation["light"].unsqueeze(-1)
        ways = observation["light_direction"].unflatten(-1, (-1, 3))
        z, mask = usable(torch.cat((measured, ways), -1), observation[self.mask_leaf] > 0)
        lamps = observation["light_map"].to(x.dtype).unflatten(-1, (-1, 3))
        apart = lamps - x[..., None, :3]  # v
        intensity, gradient = self.sensor.intensity(apart)
        seen = self.sensor.direction(apart, rotation)  # u = Rᵀ v / r
        residual = z.to(x.dtype) - torch.cat((intensity.unsqueeze(-1), seen), -1)
        spread = self.sensor.variance(intensity).unsqueeze(-1)
        angle = x.new_full((), self.angle_variance).expand(*intensity.shape, 3)
        jacobian, curvature = x.new_zeros(0), None
        if derivatives:
            jacobian = x.new_zeros(*residual.shape, process.error_size)
            jacobian[..., 0, :3] = -gradient
            by_pose = self.sensor.direction_by_pose(apart, rotation)
            jacobian[..., 1:, :3], jacobian[..., 1:, turn] = by_pose.split(3, -1)
            r = torch.linalg.vector_norm(apart, dim=-1, keepdim=True).clamp_min(1e-3)
            bend = _INTENSITY * self.sensor.power / r**4
            curvature = torch.cat((bend, (_DIRECTION / r**2).expand_as(seen)), -1)
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=torch.cat((spread, angle), -1),
            mask=mask,
            curvature=curvature,
            varies=True,
        )
