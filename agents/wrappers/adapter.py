"""What is to be known of somebody else's task so that its agents can be localized in it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from agents.wrappers.entries import Entry
from agents.wrappers.localization import Localization
from coloc_env.seeding import MOST, random_seed


@dataclass(frozen=True)
class Adapter:
    """What is to be known of somebody's task, in its own units.

    ``positions(env)``: where its agents are, [N, d] or, for B environments at once, [B, N, d].
    ``entries(env, i)``: which numbers of agent ``i``'s observation are places or velocities (see
    ``agents.wrappers.entries``); all others are kept. ``low``, ``high``: corners of the box that
    agents move in; ``dt``: seconds a step; ``metres``: what a unit measures.
    """

    positions: Callable[[Any], Any]
    entries: Callable[[Any, int], Sequence[Entry]]
    low: tuple[float, ...]
    high: tuple[float, ...]
    dt: float = 0.1
    metres: float = 10.0

    def places(self, env: Any) -> Float64[Tensor, "B N d"]:
        """The true positions, as a batch. ValueError for anything but finite numbers."""
        found = torch.as_tensor(self.positions(env)).to("cpu", torch.float64)
        found = found.unsqueeze(0) if found.ndim == 2 else found
        if found.ndim != 3 or not bool(found.isfinite().all()):
            raise ValueError(
                f"Localized: positions of shape {tuple(found.shape)} do not fit: finite numbers "
                "[agents, axes] or [environments, agents, axes] are needed"
            )
        return found

    def localization(self, localizer: str, places: Tensor, **overrides: Any) -> Localization:
        """A team of as many agents as are at ``places`` [B, N, d]."""
        b, n, _ = places.shape
        return Localization(localizer, n, self.low, self.high, self.metres, self.dt, b, **overrides)


class NoiseSeeds:
    """Seeds of the sensors' noise, one a row and episode: s, s + 1, … from where they were set."""

    def __init__(self) -> None:
        self.next = random_seed()

    def take(self, count: int) -> Int64[Tensor, "B"]:
        first, self.next = self.next, (self.next + count) % MOST
        return (first + torch.arange(count)) % MOST
