"""Measurement models: for each sensor a team believes in, residuals and their Jacobians.

A ``Block`` holds m measurements of k numbers each, per UAV, masked; filters of every kind (one per
UAV, joint, iterated, robust) work on blocks alone and never on a sensor.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.models.process import Process
from coloc_env.geometry import cross_matrix, wrap_angle
from coloc_env.observation import Observation
from coloc_env.scenario import Believed, ConstantVelocity
from coloc_env.sensors import (
    AnchorRanging,
    Height,
    LandmarkBearings,
    Landmarks,
    Ranging,
    SlowFlight,
    UavBearings,
)
from coloc_env.sensors.ranging import Tags

_BODY_FRAME = (Landmarks, LandmarkBearings, UavBearings)


@dataclass(frozen=True)
class Neighbours:
    """Where the UAVs in a UAV's slots are now, as far as it knows: position (m) and variance (m²)
    per axis, and which slots it knows anything of."""

    position: Float[Tensor, "B N S d"]
    variance: Float[Tensor, "B N S d"]
    known: Bool[Tensor, "B N S"]


def heard(believed: Believed, observation: Observation) -> Neighbours:
    """Neighbours as their messages tell: past estimates, moved on at their velocity."""
    d = believed.arena.dim
    content = observation["messages"].double().unflatten(-1, (believed.slots, 3 * d))
    age = believed.arena.dt * (1 + believed.message_delay)
    return Neighbours(
        position=content[..., :d] + age * content[..., d : 2 * d],
        variance=(2 * content[..., 2 * d :]).exp(),
        known=observation["message_mask"] > 0,
    )


@dataclass(frozen=True)
class Block:
    """m measurements of k numbers each, linearized at some state: residual z − h(x).

    ``jacobian`` is ∂h/∂δ of the UAV's own error (empty where derivatives were not asked for),
    ``variance`` the measurement's own noise (diagonal).
    Where the measurements involve the UAVs in neighbour slots, ``partner`` is ∂h/∂p of that UAV's
    position and ``partner_variance`` what its uncertainty adds; they come as (…, slot,
    ``per_slot``) flattened, and ``mutual`` says that both UAVs hold the very same number.
    """

    residual: Float[Tensor, "B N m k"]
    jacobian: Float[Tensor, "B N m k E"]
    variance: Float[Tensor, "B N m k"]
    mask: Bool[Tensor, "B N m"]
    partner: Float[Tensor, "B N m k d"] | None = None
    partner_variance: Float[Tensor, "B N m k"] | None = None
    per_slot: int = 1
    mutual: bool = False

    @property
    def total_variance(self) -> Float[Tensor, "B N m k"]:
        """Noise and, as if independent, the partner's uncertainty."""
        if self.partner_variance is None:
            return self.variance
        return self.variance + self.partner_variance


class Measurement(ABC):
    """A sensor's model. ``cooperative`` ones involve other UAVs."""

    cooperative = False

    @abstractmethod
    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        """Residuals and, unless ``derivatives`` are not wanted, Jacobians at ``x``.

        Leading dimensions are free: for particles x is [B, N, M, S] and the leaves of the
        observation and of ``neighbours`` have a dimension 1 in place of M.
        """


class LandmarkVectors(Measurement):
    """z = Rᵀ(L − p) + noise for known landmarks."""

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


class _Ranges(Measurement):
    """Distances from the UAV's own tags to points; shared by anchors and neighbours."""

    def __init__(self, std: float, tags: Tags) -> None:
        self.variance = std**2
        self.tags = tags

    def _arms(self, x: Float[Tensor, "B N S"]) -> Float[Tensor, "B N T d"]:
        """Lever arms [N, T, d], with a dimension 1 for particles where x has them."""
        arms = x.new_tensor(self.tags)
        return arms.unsqueeze(1) if x.dim() == 4 else arms

    def _own_tags(
        self, process: Process, x: Float[Tensor, "B N S"]
    ) -> tuple[Float[Tensor, "B N T d"], Float[Tensor, "B N T d t"] | None, float]:
        """Tag positions, their derivative by the attitude error, and the variance that unknown
        lever arms leave."""
        d = process.dim
        position = x[..., None, :d]
        if not self.tags:
            return position, None, 0.0
        arms = self._arms(x)
        rotation = process.rotation(x)
        if rotation is None:
            spread = float((arms**2).sum(-1).mean()) / d
            return position.expand(*x.shape[:-1], arms.shape[-2], d), None, spread
        turned = (rotation.unsqueeze(-3) @ arms.unsqueeze(-1))[..., 0]
        if d == 3:
            derivative = -rotation.unsqueeze(-3) @ cross_matrix(arms)
        else:
            derivative = torch.stack((-turned[..., 1:], turned[..., :1]), -2)
        return position + turned, derivative, 0.0

    def _block(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        ranges: Float[Tensor, "B N T P"],
        mask: Bool[Tensor, "B N T P"],
        points: Float[Tensor, "B N #T P d"],
        derivatives: bool,
    ) -> tuple[Block, Float[Tensor, "B N T P d"]]:
        """The block of all (own tag, point) pairs, and the unit vectors from point to tag."""
        tags, derivative, spread = self._own_tags(process, x)
        apart = tags.unsqueeze(-2) - points
        distance = torch.linalg.vector_norm(apart, dim=-1).clamp_min(1e-9)
        unit = apart / distance.unsqueeze(-1)
        jacobian = x.new_zeros(0)
        if derivatives:
            jacobian = x.new_zeros(*unit.shape[:-1], process.error_size)
            jacobian[..., : process.dim] = unit
            if derivative is not None:
                jacobian[..., process.attitude_error] = unit @ derivative
            jacobian = jacobian.flatten(-3, -2).unsqueeze(-2)
        residual = (ranges - distance).flatten(-2).unsqueeze(-1)
        block = Block(
            residual=residual,
            jacobian=jacobian,
            variance=x.new_tensor(self.variance + spread).expand_as(residual),
            mask=mask.flatten(-2),
        )
        return block, unit


class AnchorRanges(_Ranges):
    """Distances to anchors at known positions."""

    def __init__(self, sensor: AnchorRanging) -> None:
        super().__init__(sensor.noise.std, sensor.tags)
        self.n_tags = sensor.n_tags

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        anchors = observation["anchor_map"].to(x.dtype).unflatten(-1, (-1, process.dim))
        shape = (self.n_tags, anchors.shape[-2])
        ranges = observation["anchor_ranges"].to(x.dtype).unflatten(-1, shape)
        mask = (observation["anchor_range_mask"] > 0).unflatten(-1, shape)
        return self._block(process, x, ranges, mask, anchors.unsqueeze(-3), derivatives)[0]


class UavRanges(_Ranges):
    """Distances to neighbours, whose position is known as well as ``neighbours`` says.

    A neighbour's attitude is not in its message: its tag's lever arm counts as noise.
    """

    cooperative = True

    def __init__(self, sensor: Ranging) -> None:
        super().__init__(sensor.noise.std, sensor.tags)
        self.n_tags, self.latency = sensor.n_tags, sensor.latency
        arms = torch.tensor(sensor.tags, dtype=torch.float64) if sensor.tags else None
        self.their_arms = 0.0 if arms is None else float((arms**2).sum(-1).mean()) / arms.shape[-1]

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        t, s = self.n_tags, neighbours.known.shape[-1]

        def by_own_tag(leaf: Tensor) -> Tensor:  # [B, N, S·T·T] → [B, N, T, S·T]
            return leaf.unflatten(-1, (s, t, t)).transpose(-3, -2).flatten(-2)

        points = neighbours.position.repeat_interleave(t, -2).unsqueeze(-3)
        known = neighbours.known.repeat_interleave(t, -1).unsqueeze(-2)
        mask = (by_own_tag(observation["range_mask"]) > 0) & known
        ranges = by_own_tag(observation["ranges"].to(x.dtype))
        block, unit = self._block(process, x, ranges, mask, points, derivatives)
        variance = neighbours.variance.repeat_interleave(t, -2).unsqueeze(-3)
        added = (unit**2 * variance).sum(-1) + self.their_arms
        return Block(
            residual=block.residual,
            jacobian=block.jacobian,
            variance=block.variance,
            mask=block.mask,
            partner=-unit.flatten(-3, -2).unsqueeze(-2),
            partner_variance=added.flatten(-2).unsqueeze(-1),
            per_slot=t,
            mutual=True,
        )


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

    def __init__(self, sensor: LandmarkBearings) -> None:
        self.std, self.depth = (sensor.range_std, sensor.bearing_std), sensor.depth

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        z = observation["landmark_bearings"].to(x.dtype).unflatten(-1, (-1, 2))
        points = observation["landmark_map"].to(x.dtype).unflatten(-1, (-1, 2))
        points = torch.cat([points] * self.depth, -2)
        residual, jacobian, _ = _range_bearing(process, x, z, points)
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=(x.new_tensor(self.std) ** 2).expand_as(residual),
            mask=observation["landmark_bearing_mask"] > 0,
        )


class UavRangeBearings(Measurement):
    """Range and bearing to neighbours, whose position is known as well as ``neighbours`` says."""

    cooperative = True

    def __init__(self, sensor: UavBearings) -> None:
        self.std, self.depth = (sensor.range_std, sensor.bearing_std), sensor.depth

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        z = observation["uav_bearings"].to(x.dtype).unflatten(-1, (-1, 2))
        points = torch.cat([neighbours.position] * self.depth, -2)
        residual, jacobian, by_point = _range_bearing(process, x, z, points)
        theirs = torch.cat([neighbours.variance] * self.depth, -2)
        known = torch.cat([neighbours.known] * self.depth, -1)
        return Block(
            residual=residual,
            jacobian=jacobian,
            variance=(x.new_tensor(self.std) ** 2).expand_as(residual),
            mask=(observation["uav_bearing_mask"] > 0) & known,
            partner=by_point,
            partner_variance=(by_point**2 * theirs.unsqueeze(-2)).sum(-1),
        )


class Heights(Measurement):
    """z of the position."""

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


def make_measurements(believed: Believed) -> list[Measurement]:
    """A model for every believed sensor that measures position, attitude or other UAVs."""
    models: list[Measurement] = []
    for sensor in believed.sensors:
        if isinstance(sensor, _BODY_FRAME) and isinstance(believed.process, ConstantVelocity):
            name = type(sensor).__name__
            raise ValueError(f"{name} are in the body frame: the motion model has no attitude")
        if isinstance(sensor, Landmarks):
            models.append(LandmarkVectors(sensor))
        elif isinstance(sensor, AnchorRanging):
            models.append(AnchorRanges(sensor))
        elif isinstance(sensor, Ranging):
            models.append(UavRanges(sensor))
        elif isinstance(sensor, LandmarkBearings):
            models.append(LandmarkRangeBearings(sensor))
        elif isinstance(sensor, UavBearings):
            models.append(UavRangeBearings(sensor))
        elif isinstance(sensor, Height):
            models.append(Heights(sensor))
        elif isinstance(sensor, SlowFlight):
            models.append(Slowness(sensor))
    return models
