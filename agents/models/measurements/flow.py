"""Velocity forward and left, in the body frame."""

from jaxtyping import Float
from torch import Tensor

from agents.models.measurements.base import Block, Measurement, Neighbours, body_frame, noise_std
from agents.models.process import Process
from coloc_env.geometry import cross_matrix
from coloc_env.observation import Observation
from coloc_env.sensors import OpticalFlow
from coloc_env.sensors.base import usable


class BodyVelocities(Measurement):
    """z = (Rᵀ v)_xy + noise."""

    mask_leaf = "flow_mask"

    def __init__(self, sensor: OpticalFlow) -> None:
        self.variance = noise_std(sensor.std) ** 2

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        rotation, turn = body_frame(process, x, "flow is")
        z, mask = usable(observation["flow"].unsqueeze(-2), observation[self.mask_leaf] > 0)
        velocity = (rotation.mT @ x[..., 3:6].unsqueeze(-1))[..., 0]  # Rᵀ v
        residual = z.to(x.dtype) - velocity[..., None, :2]
        jacobian = x.new_zeros(0)
        if derivatives:
            jacobian = x.new_zeros(*residual.shape, process.error_size)
            jacobian[..., 0, :, 3:6] = rotation.mT[..., :2, :]
            jacobian[..., 0, :, turn] = cross_matrix(velocity)[..., :2, :]  # [Rᵀ v]×
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=x.new_tensor(self.variance).expand_as(residual),
            mask=mask,
        )
