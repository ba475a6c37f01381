"""Distances from a UAV's tags to anchors and to other UAVs."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.models.measurements.base import (
    Block,
    Measurement,
    Neighbours,
    believed_biases,
    noise_std,
)
from agents.models.measurements.tags import OwnTags
from agents.models.process import Process
from coloc_env.observation import Observation
from coloc_env.sensors import AnchorRanging, RangeNoise, Ranging
from coloc_env.sensors.base import usable
from coloc_env.sensors.ranging import Tags


class _Ranges(Measurement):
    """Distances from the UAV's own tags to points; shared by anchors and neighbours."""

    leaf: str
    mask_leaf: str

    def __init__(self, noise: RangeNoise, tags: Tags) -> None:
        self.noise, self.variance = noise, noise_std(noise.std) ** 2
        self.tags = OwnTags(tags)
        self.bias_std, self.bias_time = believed_biases(noise.bias_std), noise.bias_time

    def read(
        self, observation: Observation
    ) -> tuple[Float[Tensor, "B N F"], Bool[Tensor, "B N F"]]:
        """Distances (m), and where they were measured."""

        def read() -> tuple[Tensor, Tensor]:
            z = observation[self.leaf].unsqueeze(-1)
            z, mask = usable(z, observation[self.mask_leaf] > 0, ranges=True)
            return z[..., 0], mask

        return observation.once(self, read)

    def _variance(self, distance: Float[Tensor, "B N T P"]) -> Float[Tensor, "B N T*P 1"]:
        """R of each range, at the distance that is expected."""
        flat = distance.flatten(-2).unsqueeze(-1)
        if not self.noise.per_metre:
            return flat.new_full((), self.variance).expand_as(flat)
        return (noise_std(self.noise.std) + self.noise.per_metre * flat) ** 2

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
        tags, derivative, spread = self.tags.at(process, x)
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
            variance=self._variance(distance) + spread if spread else self._variance(distance),
            mask=mask.flatten(-2),
        )
        return block, unit


class AnchorRanges(_Ranges):
    """Distances to anchors at known positions."""

    leaf, mask_leaf = "anchor_ranges", "anchor_range_mask"

    def ends(
        self, observation: Observation, neighbours: Neighbours
    ) -> tuple[Float[Tensor, "B N T*P"], Float[Tensor, "B N P d"]]:
        """What was measured (m), and the points that distances are to."""
        d = neighbours.position.shape[-1]
        return self.read(observation)[0], observation["anchor_map"].unflatten(-1, (-1, d))

    def __init__(self, sensor: AnchorRanging) -> None:
        super().__init__(sensor.noise, sensor.tags)
        self.n_tags = sensor.n_tags

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        def by_tag() -> tuple[Tensor, Tensor, Tensor]:
            anchors = observation["anchor_map"].to(x.dtype).unflatten(-1, (-1, process.dim))
            shape = (self.n_tags, anchors.shape[-2])
            z, there = self.read(observation)
            ranges, mask = z.to(x.dtype).unflatten(-1, shape), there.unflatten(-1, shape)
            return ranges, mask, anchors.unsqueeze(-3)

        ranges, mask, anchors = observation.once((self, x.dtype), by_tag)
        return self._block(process, x, ranges, mask, anchors, derivatives)[0]


class UavRanges(_Ranges):
    """Distances to neighbours, whose position is uncertain as ``neighbours`` states.

    A neighbour's attitude is not in its message: its tag's lever arm counts as noise.
    """

    cooperative = True
    leaf, mask_leaf = "ranges", "range_mask"

    def ends(
        self, observation: Observation, neighbours: Neighbours
    ) -> tuple[Float[Tensor, "B N S*T*T"], Float[Tensor, "B N S d"]]:
        """What was measured (m), and the points that distances are to."""
        return self.read(observation)[0], neighbours.position

    def __init__(self, sensor: Ranging) -> None:
        super().__init__(sensor.noise, sensor.tags)
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
            if t == 1:
                return leaf.unsqueeze(-2)
            return leaf.unflatten(-1, (s, t, t)).transpose(-3, -2).flatten(-2)

        def by_their_tag(each: Tensor, dim: int) -> Tensor:
            return (each.contiguous() if t == 1 else each.repeat_interleave(t, dim)).unsqueeze(
                dim - 1
            )

        def by_tag() -> tuple[Tensor, Tensor]:
            z, there = self.read(observation)
            return by_own_tag(z.to(x.dtype)), by_own_tag(there)

        ranges, there = observation.once((self, x.dtype), by_tag)
        mask = there & by_their_tag(neighbours.known, -1)
        points = by_their_tag(neighbours.position, -2)
        block, unit = self._block(process, x, ranges, mask, points, derivatives)
        variance = by_their_tag(neighbours.variance, -2)
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
            distance=(ranges.flatten(-2).unsqueeze(-1) - block.residual).clamp_min(1e-3),
        )
