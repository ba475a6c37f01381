"""Distances between the centres of UAVs and to anchors, from ranges between tags on lever arms."""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.swarm.links import Links, lengths, ranges_of
from coloc_env.observation import Observation
from coloc_env.scenario import Believed
from coloc_env.sensors import AnchorRanging, Ranging
from coloc_env.sensors.base import usable
from coloc_env.sensors.ranging import Tags


class Centres:
    """The links of N UAVs and A anchors as one graph of M = N + A centres.

    Where attitude is estimated, a range is corrected for the lever arms of its tags; where not, the
    arms are noise. Several ranges between two centres are averaged.
    """

    def __init__(self, believed: Believed, ranging: Ranging) -> None:
        self.dim, self.ranging = believed.arena.dim, ranging
        self.anchors = believed.sensor(AnchorRanging)
        self.count = len(self.anchors.anchors) if self.anchors else 0

    def anchor_positions(self, observation: Observation) -> Float64[Tensor, "B A d"]:
        """Positions of the anchors (m)."""
        if self.anchors is None:
            return observation["prior"].new_zeros(len(observation["prior"]), 0, self.dim).double()
        return observation["anchor_map"][:, 0].double().unflatten(-1, (-1, self.dim))

    def links(
        self,
        observation: Observation,
        position: Float64[Tensor, "B N d"],
        rotation: Float64[Tensor, "B N d d"] | None,
    ) -> tuple[Links, Float64[Tensor, "B M M"]]:
        """Distances between centres, from approximate positions and attitudes (body to world), and
        each link's weight in units of a single range between UAVs; no links between anchors."""
        team, team_weight = self._between_uavs(observation, position, rotation)
        if self.anchors is None:
            return team, team_weight
        across, weight = self._to_anchors(observation, self.anchors, position, rotation)

        def joined(uavs: Tensor, anchors: Tensor) -> Tensor:
            none = uavs.new_zeros(len(uavs), self.count, self.count)
            rows = torch.cat((uavs, anchors), -1), torch.cat((anchors.mT, none), -1)
            return torch.cat(rows, -2)

        links = Links(joined(team.distance, across.distance), joined(team.mask, across.mask))
        return links, joined(team_weight, weight)

    def with_surveyed(self, links: Links, anchors: Float64[Tensor, "B A d"]) -> Links:
        """The same links with those between anchors, whose lengths are known."""
        n = links.mask.shape[-1] - self.count
        distance, mask = links.distance.clone(), links.mask.clone()
        mask[:, n:, n:] = ~torch.eye(self.count, dtype=torch.bool, device=mask.device)
        distance[:, n:, n:] = lengths(anchors) * mask[:, n:, n:]
        return Links(distance, mask)

    def _between_uavs(
        self,
        observation: Observation,
        position: Float64[Tensor, "B N d"],
        rotation: Float64[Tensor, "B N d d"] | None,
    ) -> tuple[Links, Float64[Tensor, "B N N"]]:
        ranges, mask = ranges_of(observation, self.ranging.n_tags)
        arms, variance = _arms(self.ranging.tags, position, rotation)
        if arms is not None:
            offset = arms[:, None, :, None] - arms[:, :, None, :, None]  # [B, i, j, a, b, d]
            difference = position.unsqueeze(1) - position.unsqueeze(2)
            unit = difference / lengths(position).unsqueeze(-1)
            ranges = centre_distance(ranges, offset, unit[..., None, None, :])
        weight = 1 / (1 + 2 * variance / self.ranging.noise.std**2)
        return _averaged(ranges.flatten(3), mask.flatten(3), weight)

    def _to_anchors(
        self,
        observation: Observation,
        sensor: AnchorRanging,
        position: Float64[Tensor, "B N d"],
        rotation: Float64[Tensor, "B N d d"] | None,
    ) -> tuple[Links, Float64[Tensor, "B N A"]]:
        shape = (sensor.n_tags, -1)
        z = observation["anchor_ranges"].double().unsqueeze(-1)
        z, there = usable(z, observation["anchor_range_mask"] > 0, ranges=True)
        ranges, mask = (x.unflatten(-1, shape).mT for x in (z[..., 0], there))  # [B, N, A, T]
        arms, variance = _arms(sensor.tags, position, rotation)
        if arms is not None:
            difference = self.anchor_positions(observation).unsqueeze(1) - position.unsqueeze(2)
            length = torch.linalg.vector_norm(difference, dim=-1, keepdim=True).clamp_min(1e-9)
            unit = (difference / length).unsqueeze(-2)
            ranges = centre_distance(ranges, -arms.unsqueeze(2), unit)
        weight = self.ranging.noise.std**2 / (sensor.noise.std**2 + variance)
        return _averaged(ranges, mask, weight)


def centre_distance(
    ranges: Float64[Tensor, "*s"], offset: Float64[Tensor, "*s d"], unit: Float64[Tensor, "*#s d"]
) -> Float64[Tensor, "*s"]:
    """The distance D (m) between two centres in direction u whose tags, offset by o (m), measure
    ‖D u + o‖ = r (m)."""
    along = (unit * offset).sum(-1)
    squared = ranges.square() - offset.square().sum(-1) + along.square()
    return (squared.clamp_min(0).sqrt() - along).clamp_min(1e-9)


def _arms(
    tags: Tags, position: Float64[Tensor, "B N d"], rotation: Float64[Tensor, "B N d d"] | None
) -> tuple[Float64[Tensor, "B N T d"] | None, float]:
    """Lever arms in the world frame (m), or the variance (m²) that unknown ones add to a range."""
    if not tags:
        return None, 0.0
    arms = position.new_tensor(tags)
    if rotation is None:
        return None, float(arms.square().sum(-1).mean()) / position.shape[-1]
    return (rotation.unsqueeze(2) @ arms.unsqueeze(-1))[..., 0], 0.0


def _averaged(
    ranges: Float64[Tensor, "B N M T"], mask: Bool[Tensor, "B N M T"], weight: float
) -> tuple[Links, Float64[Tensor, "B N M"]]:
    """One link for several ranges of this ``weight`` each, and the weight of the link."""
    count = mask.sum(-1)
    mean = torch.where(mask, ranges, 0.0).sum(-1) / count.clamp_min(1)
    return Links(mean, count > 0), weight * count.to(torch.float32)
