"""The magnetic field, by a map."""

from jaxtyping import Float
from torch import Tensor

from agents.models.measurements.base import Block, Measurement, Neighbours, body_frame, noise_std
from agents.models.process import Process
from coloc_env.observation import Observation
from coloc_env.sensors import Magnetic
from coloc_env.sensors.base import usable


class MappedFields(Measurement):
    """z = Rᵀ B(p) + noise, B by a map.

    The map's error stays for a time τ, so that it counts as white noise of variance
    ``map_std``² 2 τ / dt: as much as it leaves of an average over longer times.
    """

    mask_leaf = "magnetic_mask"

    def __init__(self, sensor: Magnetic) -> None:
        self.sensor = sensor
        self.bend = 15**0.5 * sensor.anomaly_std / sensor.length**2  # E‖∂²B/∂p²‖², each component

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        rotation, turn = body_frame(process, x, "the field is")
        z, mask = usable(observation["magnetic"].unsqueeze(-2), observation[self.mask_leaf] > 0)
        field, slope = self.sensor.mapped(x[..., :3])
        seen = (rotation.mT @ field.unsqueeze(-1))[..., 0]  # Rᵀ B
        residual = z.to(x.dtype) - seen.unsqueeze(-2)
        jacobian, curvature = x.new_zeros(0), None
        if derivatives:
            jacobian = x.new_zeros(*residual.shape, process.error_size)
            by_pose = self.sensor.in_body_by_pose(field, slope, rotation)
            jacobian[..., 0, :, :3], jacobian[..., 0, :, turn] = by_pose.split(3, -1)
            curvature = x.new_tensor(self.bend).expand_as(residual)
        lasting = max(1.0, 2 * self.sensor.map_time / process.dt)
        variance = noise_std(self.sensor.std) ** 2 + lasting * self.sensor.map_std**2
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=x.new_tensor(variance).expand_as(residual),
            mask=mask,
            curvature=curvature,
        )
