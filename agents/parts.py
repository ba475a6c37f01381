"""What a localizer is made of."""

from collections.abc import Iterable, Iterator
from typing import Any

import torch
from torch import Tensor, nn


def parts_of(part: Any, seen: set[int] | None = None) -> Iterator[Any]:
    """An object of this package, its parts, and so on; what lies inside a neural part aside."""
    seen = set() if seen is None else seen
    if id(part) in seen:
        return
    seen.add(id(part))
    yield part
    inside: Iterable[Any] = ()
    if isinstance(part, list | tuple):
        inside = part
    elif isinstance(part, dict):
        inside = part.values()
    elif hasattr(part, "__dict__") and type(part).__module__.split(".")[0] == "agents":
        inside = () if isinstance(part, nn.Module) else vars(part).values()
    for each in inside:
        yield from parts_of(each, seen)


def move(owner: Any, device: str | torch.device) -> None:
    """Move the networks and constants of an object of this package to a device, in place."""
    for part in parts_of(owner):
        if isinstance(part, nn.Module):
            part.to(device)
        elif hasattr(part, "__dict__") and not isinstance(part, Tensor):
            for name, value in vars(part).items():
                if isinstance(value, Tensor):
                    object.__setattr__(part, name, value.to(device))
