"""Recorded values by step."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Int64, Shaped
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Series:
    """A tensor [T, …] read by step on any device; after the last step it stays there."""

    values: Shaped[Tensor, "T *rest"]
    _copies: dict[torch.device, Tensor] = field(default_factory=dict, repr=False)

    def at(self, steps: Int64[Tensor, "*s"]) -> Tensor:
        """Values at ``steps``; one copy is kept per device."""
        device = steps.device
        if device not in self._copies:
            self._copies[device] = self.values.to(device)
        return self._copies[device][steps.clamp(max=len(self.values) - 1)]
