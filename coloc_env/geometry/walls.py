"""Solid boxes, and columns, between two points: how much of the line of sight lies inside them."""

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from coloc_env.motion import Box


def depth(
    start: Float64[Tensor, "*#s d"], end: Float64[Tensor, "*#s d"], walls: tuple[Box, ...]
) -> Float64[Tensor, "*s"]:
    """Metres of each segment that lie inside the walls, those of several walls added; 0 where it
    touches none or runs along a face."""
    axes, squared = _line(start, end)
    share = torch.zeros_like(squared)
    for inside in _shares(axes, squared, walls):
        share = share + inside
    return share * squared.sqrt()


def crossed(
    start: Float64[Tensor, "*#s d"], end: Float64[Tensor, "*#s d"], walls: tuple[Box, ...]
) -> Int64[Tensor, "*s"]:
    """How many of the walls each segment passes through; the same number from either end."""
    axes, squared = _line(start, end)
    count = torch.zeros_like(squared, dtype=torch.int64)
    for inside in _shares(axes, squared, walls):
        count += inside > 0
    return count


def near(
    start: Float64[Tensor, "*#s d"],
    end: Float64[Tensor, "*#s d"],
    centre: Float64[Tensor, "*#s c"],
    radius: float,
) -> Bool[Tensor, "*s"]:
    """Which segments come nearer than ``radius`` m, seen from above, to the axis of a column that
    stands from the floor to the ceiling; the same from either end.

    ``centre``: where it stands (m), of which the first two components count.
    """
    way, square, toward = [], None, None
    for a, b, c in zip(
        start.unbind(-1)[:2], end.unbind(-1)[:2], centre.unbind(-1)[:2], strict=True
    ):
        middle, half = 0.5 * (a + b) - c, 0.5 * (b - a)
        way.append((middle, half))
        square = half * half if square is None else square + half * half
        toward = middle * half if toward is None else toward + middle * half
    assert square is not None
    assert toward is not None
    # The nearest point is m + t h, t = −m·h / h², between the ends −1 and 1.
    t = torch.where(square > 0, -toward / square, 0.0).clamp(-1.0, 1.0)
    x, y = (middle + t * half for middle, half in way)
    return x * x + y * y < radius**2


def _line(
    start: Float64[Tensor, "*#s d"], end: Float64[Tensor, "*#s d"]
) -> tuple[list[tuple[Tensor, Tensor]], Float64[Tensor, "*s"]]:
    """Middle and 1 / half of each segment along each axis, and the square of its half length."""
    axes, squared = [], None
    for a, b in zip(start.unbind(-1), end.unbind(-1), strict=True):
        middle, half = 0.5 * (a + b), 0.5 * (b - a)
        squared = half * half if squared is None else squared + half * half
        axes.append((middle, 1 / half))
    assert squared is not None
    return axes, squared


def _shares(
    axes: list[tuple[Tensor, Tensor]], squared: Float64[Tensor, "*s"], walls: tuple[Box, ...]
) -> Iterator[Float64[Tensor, "*s"]]:
    """How much of each segment is in each wall, in half lengths.

    Slab method (Kay & Kajiya, SIGGRAPH 1986), one axis at a time, from the segment's middle: the
    same number from either end. Where a segment is parallel to an axis its rate is infinite, which
    is as it should be; on a face it is then infinity times 0.
    """
    for low, high in walls:
        enter, leave = torch.full_like(squared, -1.0), torch.ones_like(squared)
        for (middle, rate), bottom, top in zip(axes, low, high, strict=True):
            first, second = (bottom - middle) * rate, (top - middle) * rate
            enter = torch.maximum(enter, torch.minimum(first, second))
            leave = torch.minimum(leave, torch.maximum(first, second))
        yield (leave - enter).clamp_min(0.0).nan_to_num(0.0)
