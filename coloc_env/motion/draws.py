"""What motions draw: keys per UAV, uniform points, and constants kept on their device."""

import math
from functools import lru_cache

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env import noise

GOLDEN = 0.5 * (math.sqrt(5) - 1)  # whose multiples, modulo 1, are never near those just before


@lru_cache(maxsize=256)
def constant(values: tuple, device: torch.device) -> Float64[Tensor, "*s"]:
    """A nested tuple of numbers as a tensor, made once per device; never write to it."""
    return torch.tensor(values, dtype=torch.float64, device=device)


def uav_keys(keys: Int64[Tensor, "R"], n_uavs: int) -> Int64[Tensor, "R N"]:
    """A key per world and UAV."""
    uavs = torch.arange(n_uavs, device=keys.device)
    return noise.fold(keys.unsqueeze(-1).expand(-1, n_uavs), uavs.expand(len(keys), -1))


def fold_each(
    keys: Int64[Tensor, "R N"], index: Int64[Tensor, "*m R K N"]
) -> Int64[Tensor, "*m R K N"]:
    """Keys of numbered draws, a step's or a control point's; ``index`` may be 1 wide over UAVs."""
    return noise.fold(*torch.broadcast_tensors(keys.unsqueeze(1), index))


def following(first: Int64[Tensor, "R K N"], count: int) -> Int64[Tensor, "m R K N"]:
    """``count`` consecutive numbers from ``first`` on."""
    return first + torch.arange(count, device=first.device).view(-1, 1, 1, 1)


def uniform(keys: Int64[Tensor, "*s"], stream: str, count: int) -> Float64[Tensor, "*s n"]:
    """``count`` numbers in (0, 1) per key, in float64."""
    return noise.uniform(keys, stream, count).to(torch.float64)


def points(
    keys: Int64[Tensor, "*s"], stream: str, low: tuple[float, ...], high: tuple[float, ...]
) -> Float64[Tensor, "*s d"]:
    """One point per key, uniform in a box (m)."""
    sides = tuple(b - a for a, b in zip(low, high, strict=True))
    drawn = uniform(keys, stream, len(low))
    return constant(low, keys.device) + constant(sides, keys.device) * drawn


def phases(keys: Int64[Tensor, "R"], n_uavs: int, parts: int) -> Float64[Tensor, "R N"]:
    """Fraction i / parts of a cycle for UAV i: how a team is spread along one path."""
    share = torch.arange(n_uavs, device=keys.device, dtype=torch.float64) / parts
    return share.repeat(len(keys), 1)


def between(
    u: Float64[Tensor, "*s"], low: float | Tensor, high: float | Tensor
) -> Float64[Tensor, "*s"]:
    """Numbers between two limits from numbers in (0, 1)."""
    return low + (high - low) * u
