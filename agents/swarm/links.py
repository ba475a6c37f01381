"""Ranges between the members of a team, as symmetric matrices."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from coloc_env.observation import Observation
from coloc_env.sensors.base import usable


@dataclass(frozen=True)
class Links:
    """Ranges d̃_ij between UAVs: ``distance`` in m (0 where there is none), ``mask``: which were
    measured."""

    distance: Float64[Tensor, "B N N"]
    mask: Bool[Tensor, "B N N"]


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
    reach = mask.clone()
    reach.diagonal(dim1=-2, dim2=-1).fill_(True)
    while True:
        paths = reach.to(torch.float32)
        further = paths @ paths > 0
        if torch.equal(further, reach):
            return reach
        reach = further


def along_links(
    y: Float64[Tensor, "B N d"], strength: Float64[Tensor, "B *K N N"], length: Tensor
) -> Float64[Tensor, "B *K N d"]:
    """Σ_j s_ij u_ij, u_ij the unit vector from j to i."""
    s = strength / length
    return s.sum(-1, keepdim=True) * y - s @ y


def own_information(
    y: Float64[Tensor, "B N d"],
    weight: Float64[Tensor, "B N N"],
    length: Float64[Tensor, "B N N"],
) -> Float64[Tensor, "B N d d"]:
    """Σ_j W_ij u_ij u_ijᵀ (1/m²): information of links on a UAV whose neighbours are fixed."""
    s = weight / length.square()
    d = y.shape[-1]
    outer = (y.unsqueeze(-1) * y.unsqueeze(-2)).flatten(-2)
    moments = s @ torch.cat((y, outer), -1)
    first, second = moments[..., :d], moments[..., d:].unflatten(-1, (d, d))
    own = outer.unflatten(-1, (d, d)) * s.sum(-1)[..., None, None]
    cross = y.unsqueeze(-1) * first.unsqueeze(-2)
    return own + second - cross - cross.mT
