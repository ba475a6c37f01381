"""UAVs that keep to boxes: which box each flies in, its walls, and paths reflected at them."""

import math
from collections.abc import Iterable
from dataclasses import replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Box
from coloc_env.motion.draws import constant, uniform
from coloc_env.motion.timing import alternating


def rooms(boxes: tuple[Box, ...], arena: Arena) -> tuple[Arena, ...]:
    """Each box as an arena of its own; the arena itself where there are none."""
    return tuple(replace(arena, low=low, high=high) for low, high in boxes) or (arena,)


def assigned(spaces: tuple[Arena, ...], keys: Int64[Tensor, "R N"]) -> Int64[Tensor, "R N"]:
    """The index of the room that each UAV flies in, drawn in proportion to their volumes."""
    if len(spaces) == 1:
        return torch.zeros_like(keys)
    sides = (zip(room.low, room.high, strict=True) for room in spaces)
    volumes = tuple(math.prod(high - low for low, high in room) for room in sides)
    ends = constant(volumes, keys.device).cumsum(0)
    return torch.bucketize(ends[-1] * uniform(keys, "motion.box", 1)[..., 0], ends[:-1])


def of_each(
    room: Int64[Tensor, "R N"], values: Iterable[tuple[float, ...]]
) -> tuple[Float64[Tensor, "R N"], ...]:
    """For each UAV what belongs to its room; ``values`` has a tuple for each room."""
    return constant(tuple(values), room.device)[room].unbind(-1)


def walls(
    spaces: tuple[Arena, ...], room: Int64[Tensor, "R N"]
) -> tuple[Float64[Tensor, "R N d"], Float64[Tensor, "R N d"]]:
    """Lowest and highest corner (m) of the room that each UAV flies in."""
    corners = constant(tuple((space.low, space.high) for space in spaces), room.device)[room]
    low, high = corners.unbind(-2)
    return low, high


def reflected(
    low: Float64[Tensor, "*w"], high: Float64[Tensor, "*w"], unfolded: Float64[Tensor, "*s"]
) -> tuple[Float64[Tensor, "*s"], Float64[Tensor, "*s"]]:
    """Coordinates that went straight on through mirror images of a box, folded back into it.

    Also the sense, 1 or −1, of each axis there: every second image is mirrored.
    """
    side = high - low
    image = ((unfolded - low) / side).floor()
    within = unfolded - low - image * side
    sense = alternating(image)
    place = torch.where(sense > 0, low + within, high - within)
    return torch.clamp(place, low, high), sense
