"""Measurements that are linear in position or velocity: landmark vectors, fixes, heights,
slowness."""

from abc import abstractmethod
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.models.measurements.base import (
    Block,
    Measurement,
    Neighbours,
    believed_biases,
    body_frame,
    noise_std,
)
from agents.models.process import Process
from coloc_env.geometry import cross_matrix
from coloc_env.observation import Observation
from coloc_env.sensors import Height, Landmarks, PositionFix, SlowFlight, UnlabelledLandmarks
from coloc_env.sensors.base import usable


class LandmarkVectors(Measurement):
    """z = Rᵀ(L − p) + noise for known landmarks; where they come without names, ``association``
    gives them some before."""

    mask_leaf = "landmark_mask"

    def __init__(self, sensor: Landmarks | UnlabelledLandmarks) -> None:
        self.std = noise_std(sensor.std)

    def read(
        self, observation: Observation, dim: int
    ) -> tuple[Float[Tensor, "B N m d"], Bool[Tensor, "B N m"]]:
        """What was measured (m), and where."""
        z = observation["landmarks"].unflatten(-1, (-1, dim))
        return observation.once(self, lambda: usable(z, observation["landmark_mask"] > 0))

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        d = process.dim
        rotation, turn = body_frame(process, x, "landmark vectors are")
        z, mask = self.read(observation, d)
        known, z = observation.once(
            (self, x.dtype),
            lambda: (
                observation["landmark_map"].to(x.dtype).unflatten(-1, (-1, d)),
                z.to(x.dtype),
            ),
        )
        expected = (known - x[..., None, :d]) @ rotation
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
            variance=x.new_full((), self.std**2).expand_as(residual),
            mask=mask,
        )


class _Coordinates(Measurement):
    """Some components of position or velocity themselves, as one measurement."""

    def __init__(self, sensor: PositionFix | Height | SlowFlight) -> None:
        self.sensor = sensor

    def variance(self, dim: int) -> float | list[float]:
        """R of each component."""
        return noise_std(self.sensor.std) ** 2

    @abstractmethod
    def components(self, dim: int) -> slice:
        """Which of the state's (and of its error's)."""

    @abstractmethod
    def measured(self, observation: Observation) -> Float[Tensor, "B N c"] | float:
        """What they were measured to be."""

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        part, z = self.components(process.dim), self.measured(observation)
        mask = x.new_ones(*x.shape[:-1], 1, dtype=torch.bool)
        if self.mask_leaf is not None:
            mask = observation[self.mask_leaf] > 0
        if isinstance(z, Tensor):
            whole, mask = usable(z.unsqueeze(-2), mask)
            z = whole[..., 0, :].to(x.dtype)
        residual = (z - x[..., part]).unsqueeze(-2)
        jacobian = x.new_zeros(*residual.shape, process.error_size)
        jacobian[..., part] = torch.eye(residual.shape[-1], dtype=x.dtype, device=x.device)
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=x.new_tensor(self.variance(process.dim)).expand_as(residual),
            mask=mask,
        )


class PositionFixes(_Coordinates):
    """z = p + noise."""

    mask_leaf = "position_fix_mask"

    def __init__(self, sensor: PositionFix) -> None:
        super().__init__(sensor)
        self.axis_std = sensor.axis_std

    def variance(self, dim: int) -> list[float]:
        return [noise_std(std) ** 2 for std in self.axis_std(dim)]

    def components(self, dim: int) -> slice:
        return slice(0, dim)

    def measured(self, observation: Observation) -> Float[Tensor, "B N d"]:
        return observation["position_fix"]


class Heights(_Coordinates):
    """z of the position, and the bias where the motion model has it as a state."""

    mask_leaf = "height_mask"

    def __init__(self, sensor: Height) -> None:
        super().__init__(sensor)
        if not sensor.estimated:
            self.bias_std, self.bias_time = believed_biases(sensor.bias_std), sensor.bias_time

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        block = super().linearize(process, x, observation, neighbours, derivatives)
        if not process.drift_size:
            return block
        block.jacobian[..., -1] = 1.0
        return replace(block, residual=block.residual - x[..., -1:].unsqueeze(-2))

    def components(self, dim: int) -> slice:
        return slice(2, 3)

    def measured(self, observation: Observation) -> Float[Tensor, "B N 1"]:
        return observation["height"]


class Slowness(_Coordinates):
    """Velocity about zero."""

    testable = False

    def components(self, dim: int) -> slice:
        return slice(dim, 2 * dim)

    def measured(self, observation: Observation) -> float:
        return 0.0
