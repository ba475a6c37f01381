"""Heading of the body's forward axis."""

from jaxtyping import Float
from torch import Tensor

from agents.models.measurements.base import Block, Measurement, Neighbours, body_frame, noise_std
from agents.models.process import Process
from coloc_env.geometry import wrap_angle
from coloc_env.observation import Observation
from coloc_env.sensors import Compass
from coloc_env.sensors.base import usable
from coloc_env.sensors.compass import heading


class Headings(Measurement):
    """z = ψ(R) + noise, on the circle."""

    mask_leaf = "compass_mask"

    def __init__(self, sensor: Compass) -> None:
        self.variance = noise_std(sensor.std) ** 2

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        rotation, turn = body_frame(process, x, "headings are")
        z, mask = usable(observation["compass"].unsqueeze(-2), observation[self.mask_leaf] > 0)
        expected, by_turn = heading(rotation)
        residual = wrap_angle(z.to(x.dtype) - expected[..., None, None])
        jacobian = x.new_zeros(0)
        if derivatives:
            jacobian = x.new_zeros(*residual.shape, process.error_size)
            jacobian[..., 0, 0, turn] = by_turn
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=x.new_tensor(self.variance).expand_as(residual),
            mask=mask,
        )
