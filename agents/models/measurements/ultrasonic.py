"""Distances to the nearest walls along the body's axes."""

import math

from jaxtyping import Float
from torch import Tensor

from agents.models.measurements.base import Block, Measurement, Neighbours, body_frame, noise_std
from agents.models.process import Process
from coloc_env.observation import Observation
from coloc_env.sensors import Ultrasonic
from coloc_env.sensors.base import usable

_STRAY = 0.05  # of echoes that are believed to come from anywhere within reach


class WallDistances(Measurement):
    """z = t + noise, t the distance along each beam R e to the first surface of a known room."""

    mask_leaf = "ultrasonic_mask"

    def __init__(self, sensor: Ultrasonic) -> None:
        self.sensor, self.variance = sensor, noise_std(sensor.std) ** 2
        self.stray = _STRAY * (2 * math.pi * self.variance) ** 0.5 / sensor.reach

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        rotation, turn = body_frame(process, x, "beams are")
        z, mask = usable(
            observation["ultrasonic"].unsqueeze(-1), observation[self.mask_leaf] > 0, ranges=True
        )
        expected, by_pose = self.sensor.expected(x[..., :3], rotation)
        residual = z.to(x.dtype) - expected.unsqueeze(-1)
        jacobian, curvature = x.new_zeros(0), None
        if derivatives:
            jacobian = x.new_zeros(*residual.shape, process.error_size)
            jacobian[..., 0, :3], jacobian[..., 0, turn] = by_pose[..., :3], by_pose[..., 3:]
            curvature = self.sensor.curvature(x[..., :3], rotation).unsqueeze(-1)
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=x.new_tensor(self.variance).expand_as(residual),
            mask=mask,
            curvature=curvature,
            stray=self.stray,
        )
