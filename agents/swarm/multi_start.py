"""Several starts of one solution, of which the best counts: against flips in sparse graphs."""

from collections.abc import Callable, Iterator

import torch
from jaxtyping import Float64
from torch import Tensor

Found = tuple[Float64[Tensor, "B N d"], Float64[Tensor, "B N 2"]]


def starts_about(
    start: Float64[Tensor, "B N d"], variance: Float64[Tensor, "B N"], count: int
) -> Iterator[Float64[Tensor, "B N d"]]:
    """``start`` and ``count`` − 1 draws about it, of ``variance`` (m²) per axis; the same draws in
    every world and step."""
    yield start
    draws = torch.Generator().manual_seed(0)  # the CPU's: the same on every device
    for _ in range(count - 1):
        white = torch.randn(start.shape[1:], generator=draws, dtype=start.dtype)
        yield start + variance.sqrt().unsqueeze(-1) * white.to(start.device)


def best_of(
    solve: Callable[[Float64[Tensor, "B N d"]], Found],
    cost: Callable[[Float64[Tensor, "B N d"], Float64[Tensor, "B N 2"]], Float64[Tensor, "B"]],
    starts: Iterator[Float64[Tensor, "B N d"]],
) -> Found:
    """The solution of the least cost, world by world."""
    position, delay = solve(next(starts))
    least = None
    for start in starts:
        least = cost(position, delay) if least is None else least
        other, other_delay = solve(start)
        found = cost(other, other_delay)
        better = (found < least)[:, None, None]
        position, delay = (
            torch.where(better, a, b) for a, b in ((other, position), (other_delay, delay))
        )
        least = torch.minimum(found, least)
    return position, delay
