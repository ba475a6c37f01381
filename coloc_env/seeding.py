"""Seeds of worlds: what may be one, and a random one where none is given."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

MOST = 2**62  # seeds lie below


def checked_seed(seed: Any, owner: str = "seed") -> int:
    """The seed as an int. Raises ValueError for anything but a whole number from 0 to 2⁶²."""
    whole = isinstance(seed, (int, np.integer)) and not isinstance(seed, bool)
    if not whole or not 0 <= seed < MOST:
        raise ValueError(f"{owner}: seed={seed!r} is not allowed: a whole number from 0 to 2^62")
    return int(seed)


def checked_seeds(seeds: Any, count: int, device: torch.device) -> Int64[Tensor, "B"]:
    """``count`` seeds, one a row; one integer s stands for s, s + 1, ….

    Raises ValueError for another number of them, and for a seed that is none.
    """
    if not isinstance(seeds, (Sequence, np.ndarray, Tensor)):
        first = checked_seed(seeds, "World")
        return torch.arange(first, first + count, device=device)
    if not isinstance(seeds, Tensor):
        seeds = torch.tensor([checked_seed(seed, "World") for seed in seeds], dtype=torch.int64)
    if seeds.shape != (count,):
        raise ValueError(
            f"World: {count} seeds are needed, one a row, got {tuple(seeds.shape)} of them"
        )
    if seeds.is_floating_point() or seeds.is_complex() or seeds.dtype == torch.bool:
        checked_seed(seeds[0].item(), "World")
        raise ValueError(f"World: seeds of {seeds.dtype} are not allowed: whole numbers are needed")
    wrong = seeds[(seeds < 0) | (seeds >= MOST)]
    if len(wrong):
        checked_seed(wrong[0].item(), "World")
    return seeds.to(device, torch.int64)


def random_seed() -> int:
    """A seed that nobody chose, from the operating system's entropy; below 2³²."""
    return int(np.random.SeedSequence().generate_state(1)[0])
