"""Solid boxes in the way: where what moves is stopped."""

import torch
from jaxtyping import Float64
from torch import Tensor

from coloc_env.motion.base import Box


def stopped(
    start: Float64[Tensor, "*s d"], end: Float64[Tensor, "*s d"], walls: tuple[Box, ...]
) -> Float64[Tensor, "*s d"]:
    """Where a straight move ends: at ``end``, or, where a wall is in the way, on the face that it
    meets, along which the rest of it goes on. Nobody starts inside a wall."""
    place = end
    for low, high in walls:
        bottom, top = start.new_tensor(low), start.new_tensor(high)
        way = place - start
        still = way == 0
        within = (start > bottom) & (start < top)
        first, second = (bottom - start) / way, (top - start) / way
        enter = torch.where(
            still, torch.where(within, -torch.inf, torch.inf), first.minimum(second)
        )
        leave = torch.where(still, torch.inf, first.maximum(second))
        enters, axis = enter.max(-1, keepdim=True)
        meets = (enters >= 0) & (enters < 1) & (enters < leave.amin(-1, keepdim=True))
        face = torch.where(way > 0, bottom, top)
        here = meets & (torch.arange(start.shape[-1], device=start.device) == axis)
        place = torch.where(here, face, place)
    for low, high in walls:  # slid from one into another: does not move
        inside = (place > start.new_tensor(low)) & (place < start.new_tensor(high))
        place = torch.where(inside.all(-1, keepdim=True), start, place)
    return place
