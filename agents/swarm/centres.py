"""Distances between the centres of UAVs and to anchors, from ranges between tags on lever arms."""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.swarm.links import Links, lengths, ranges_of
from coloc_env.observation import Observation
from coloc_env.scenario import Believed
from coloc_env.sensors import AnchorRanging, Ranging
from coloc_env.sensors.ranging import Tags


class Centres:
    """The links of a team of N, and of the A anchors that it believes in, if any, as one graph of
    M = N + A centres.

    Where attitude is known, a range is corrected for the lever arms of its tags; where not, they
    are noise. Several ranges between two centres are averaged.
    """

    def __init__(self, believed: Believed, ranging: Ranging) -> None:
        self.dim, self.ranging = believed.arena.dim, ranging
        self.anchors = believed.sensor(AnchorRanging)
        self.count = len(self.anchors.anchors) if self.anchors else 0

    def places(self, observation: Observation) -> Float64[Tensor, "B A d"]:
        """Where the anchors are (m)."""
        if self.anchors is None:
            return observation["prior"].new_zeros(len(observation["prior"]), 0, self.dim).double()
        return observation["anchor_map"][:, 0].double().unflatten(-1, (-1, self.dim))

    def links(
        self,
        observation: Observation,
        place: Float64[Tensor, "B N d"],
        rotation: Float64[Tensor, "B N d d"] | None,
    ) -> tuple[Links, Float64[Tensor, "B M M"]]:
        """Distances between centres, at places and attitudes (body to world) that are about right,
        and how many single ranges between UAVs each is worth; none between anchors."""
        inside, worth = self._between(observation, place, rotation)
        if self.anchors is None:
            return inside, worth
        across, shares = self._to_anchors(observation, self.anchors, place, rotation)

        def joined(ours: Tensor, theirs: Tensor) -> Tensor:
            none = ours.new_zeros(len(ours), self.count, self.count)
            rows = torch.cat((ours, theirs), -1), torch.cat((theirs.mT, none), -1)
            return torch.cat(rows, -2)

        links = Links(joined(inside.distance, across.distance), joined(inside.mask, across.mask))
        return links, joined(worth, shares)

    def surveyed(self, links: Links, anchors: Float64[Tensor, "B A d"]) -> Links:
        """The same links with those between anchors, whose lengths are known."""
        n = links.mask.shape[-1] - self.count
        distance, mask = links.distance.clone(), links.mask.clone()
        mask[:, n:, n:] = ~torch.eye(self.count, dtype=torch.bool, device=mask.device)
        distance[:, n:, n:] = lengths(anchors) * mask[:, n:, n:]
        return Links(distance, mask)

    def _between(
        self,
        observation: Observation,
        place: Float64[Tensor, "B N d"],
        rotation: Float64[Tensor, "B N d d"] | None,
    ) -> tuple[Links, Float64[Tensor, "B N N"]]:
        ranges, mask = ranges_of(observation, self.ranging.n_tags)
        arms, spread = _arms(self.ranging.tags, place, rotation)
        if arms is not None:
            offset = arms[:, None, :, None] - arms[:, :, None, :, None]  # [B, i, j, a, b, d]
            apart = place.unsqueeze(1) - place.unsqueeze(2)
            unit = apart / lengths(place).unsqueeze(-1)
            ranges = centred(ranges, offset, unit[..., None, None, :])
        share = 1 / (1 + 2 * spread / self.ranging.noise.std**2)
        return _averaged(ranges.flatten(3), mask.flatten(3), share)

    def _to_anchors(
        self,
        observation: Observation,
        sensor: AnchorRanging,
        place: Float64[Tensor, "B N d"],
        rotation: Float64[Tensor, "B N d d"] | None,
    ) -> tuple[Links, Float64[Tensor, "B N A"]]:
        shape = (sensor.n_tags, -1)
        ranges = observation["anchor_ranges"].double().unflatten(-1, shape).mT  # [B, N, A, T]
        mask = (observation["anchor_range_mask"] > 0).unflatten(-1, shape).mT & ranges.isfinite()
        arms, spread = _arms(sensor.tags, place, rotation)
        if arms is not None:
            apart = self.places(observation).unsqueeze(1) - place.unsqueeze(2)
            length = torch.linalg.vector_norm(apart, dim=-1, keepdim=True).clamp_min(1e-9)
            ranges = centred(ranges, -arms.unsqueeze(2), (apart / length).unsqueeze(-2))
        share = self.ranging.noise.std**2 / (sensor.noise.std**2 + spread)
        return _averaged(ranges, mask, share)


def centred(
    ranges: Float64[Tensor, "*s"], offset: Float64[Tensor, "*s d"], unit: Float64[Tensor, "*#s d"]
) -> Float64[Tensor, "*s"]:
    """The distance D (m) between two centres in direction ``unit`` whose tags, ``offset`` m further
    apart, are ‖D u + o‖ = r m from each other."""
    along = (unit * offset).sum(-1)
    squared = ranges.square() - offset.square().sum(-1) + along.square()
    return (squared.clamp_min(0).sqrt() - along).clamp_min(1e-9)


def _arms(
    tags: Tags, place: Float64[Tensor, "B N d"], rotation: Float64[Tensor, "B N d d"] | None
) -> tuple[Float64[Tensor, "B N T d"] | None, float]:
    """Lever arms in the world frame, or what not knowing them adds to a range's variance (m²)."""
    if not tags:
        return None, 0.0
    arms = place.new_tensor(tags)
    if rotation is None:
        return None, float(arms.square().sum(-1).mean()) / place.shape[-1]
    return (rotation.unsqueeze(2) @ arms.unsqueeze(-1))[..., 0], 0.0


def _averaged(
    ranges: Float64[Tensor, "B N M T"], mask: Bool[Tensor, "B N M T"], share: float
) -> tuple[Links, Float64[Tensor, "B N M"]]:
    """One link for several ranges, each of which is worth a ``share`` of one; and its worth."""
    count = mask.sum(-1)
    mean = torch.where(mask, ranges, 0.0).sum(-1) / count.clamp_min(1)
    return Links(mean, count > 0), share * count.to(torch.float32)
