"""Ranges between the members of a team, as symmetric matrices."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.swarm.pairs import Pairs, pairs_of
from coloc_env.observation import Observation
from coloc_env.sensors.base import usable


@dataclass(frozen=True)
class Links:
    """Ranges d̃_ij between UAVs: ``distance`` in m (0 where there is none), ``mask``: which were
    measured. They are matrices [B, N, N], or lists [B, E] of the pairs ``listed``."""

    distance: Float64[Tensor, "B *L"]
    mask: Bool[Tensor, "B *L"]
    listed: Pairs | None = None

    @cached_property
    def pairs(self) -> Pairs:
        """The links that there are."""
        return pairs_of(self.mask) if self.listed is None else self.listed

    def lengths(self, y: Float64[Tensor, "B N d"]) -> Float64[Tensor, "B *L"]:
        """Distances between members at y, as matrices or lists (m, 1e-9 at least)."""
        return lengths(y) if self.listed is None else self.listed.units(y)[1]


def links_of(observation: Observation) -> Links:
    """The links that either end reports, in teams with one tag a UAV."""
    ranges, mask = (x[..., 0, 0] for x in ranges_of(observation, 1))
    return Links(ranges, mask)


def ranges_of(
    observation: Observation, tags: int
) -> tuple[Float64[Tensor, "B N N T T"], Bool[Tensor, "B N N T T"]]:
    """Ranges (m) between UAVs i and j, tag a of the one and b of the other, [B, i, j, a, b], that
    either end reports, and which there are: from the leaves ``ranges`` and ``range_mask`` and, in
    teams with more UAVs than slots, ``neighbours``."""
    shape = (-1, tags, tags)
    z = observation["ranges"].double().unsqueeze(-1)
    z, there = usable(z, observation["range_mask"] > 0, ranges=True)
    ranges, mask = z[..., 0].unflatten(-1, shape), there.unflatten(-1, shape)
    n = ranges.shape[1]
    if "neighbours" in observation:
        index = observation["neighbours"].to(torch.int64)[..., None, None].expand(mask.shape)
        there = torch.zeros(*mask.shape[:2], n, tags, tags, dtype=torch.bool, device=mask.device)
        wide = ranges.new_zeros(there.shape)
        # An empty slot names UAV 0: its value is written to the diagonal, where it changes nothing.
        own = torch.arange(n, device=mask.device)[:, None, None, None]
        index = torch.where(mask, index, own)
        ranges = wide.scatter(2, index, torch.where(mask, ranges, 0.0))
        mask = there.scatter(2, index, mask)
    theirs = mask.transpose(1, 2).mT
    both = torch.where(mask, ranges, ranges.transpose(1, 2).mT)
    either = mask | theirs
    return torch.where(either, both, 0.0), either


def lengths(position: Float64[Tensor, "B N d"]) -> Float64[Tensor, "B N N"]:
    """Distances between all members (m, 1e-9 at least)."""
    apart = torch.cdist(position, position, compute_mode="donot_use_mm_for_euclid_dist")
    return apart.clamp_min(1e-9)


def of_both_ends(memory: Float64[Tensor, "B N M"]) -> Float64[Tensor, "B M M"]:
    """What is remembered of links between M members, from the rows of the first N of them: it is
    the same at both ends, and nothing of links between the others."""
    n, m = memory.shape[1:]
    rows = torch.nn.functional.pad(memory[..., n:].mT, (0, m - n))
    return torch.cat((memory, rows), 1)


def connected(mask: Bool[Tensor, "B N N"]) -> Bool[Tensor, "B N N"]:
    """Pairs in the same connected component of the network, each UAV with itself."""
    first = pairs_of(mask).components()
    return first.unsqueeze(-1) == first.unsqueeze(-2)


def along_links(
    y: Float64[Tensor, "B N d"], strength: Float64[Tensor, "B *K N N"], length: Tensor
) -> Float64[Tensor, "B *K N d"]:
    """Σ_j s_ij u_ij, u_ij the unit vector from j to i."""
    s = strength / length
    return s.sum(-1, keepdim=True) * y - s @ y


def own_information(
    y: Float64[Tensor, "B N d"], s: Float64[Tensor, "B N N"]
) -> Float64[Tensor, "B N d d"]:
    """Σ_j W_ij u_ij u_ijᵀ (1/m²), from s_ij = W_ij / ‖y_i − y_j‖² (1/m⁴): information of links on a
    UAV whose neighbours are fixed."""
    d = y.shape[-1]
    outer = (y.unsqueeze(-1) * y.unsqueeze(-2)).flatten(-2)
    moments = s @ torch.cat((y, outer), -1)
    first, second = moments[..., :d], moments[..., d:].unflatten(-1, (d, d))
    own = outer.unflatten(-1, (d, d)) * s.sum(-1)[..., None, None]
    cross = y.unsqueeze(-1) * first.unsqueeze(-2)
    return own + second - cross - cross.mT
