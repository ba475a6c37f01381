"""Solid boxes between two points: how much of the line of sight lies inside them."""

import torch
from jaxtyping import Float64
from torch import Tensor

from coloc_env.motion import Box


def depth(
    start: Float64[Tensor, "*#s d"], end: Float64[Tensor, "*#s d"], walls: tuple[Box, ...]
) -> Float64[Tensor, "*s"]:
    """Metres of each segment that lie inside the walls, those of several walls added; 0 where it
    touches none or runs along a face.

    Slab method (Kay & Kajiya, SIGGRAPH 1986), one axis at a time, from the segment's middle: the
    same number from either end. Where a segment is parallel to an axis its rate is infinite, which
    is as it should be; on a face it is then infinity times 0.
    """
    axes, squared = [], None
    for a, b in zip(start.unbind(-1), end.unbind(-1), strict=True):
        middle, half = 0.5 * (a + b), 0.5 * (b - a)
        squared = half * half if squared is None else squared + half * half
        axes.append((middle, 1 / half))
    assert squared is not None
    share = torch.zeros_like(squared)
    for low, high in walls:
        enter, leave = torch.full_like(squared, -1.0), torch.ones_like(squared)
        for (middle, rate), bottom, top in zip(axes, low, high, strict=True):
            first, second = (bottom - middle) * rate, (top - middle) * rate
            enter = torch.maximum(enter, torch.minimum(first, second))
            leave = torch.minimum(leave, torch.maximum(first, second))
        share = share + (leave - enter).clamp_min(0.0).nan_to_num(0.0)
    return share * squared.sqrt()
