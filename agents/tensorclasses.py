"""Building tensorclasses in every step of a filter."""

from typing import Any, TypeVar

import torch
from tensordict import TensorDict

T = TypeVar("T")


def build(kind: type[T], batch_size: torch.Size, **entries: Any) -> T:
    """What ``kind(**entries, batch_size=batch_size)`` makes, at a third of the price: constructors
    of tensorclasses look at each entry for themselves."""
    made: T = kind.from_tensordict(TensorDict(entries, batch_size=batch_size))  # type: ignore[attr-defined]
    return made
