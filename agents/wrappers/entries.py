"""Which numbers of another environment's observations say where its agents are, and how each is
worked out from estimates instead of the truth."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from agents.wrappers.localization import Localization

Quantity = Literal["position", "velocity"]


class Moment(NamedTuple):
    """What there is to work an entry out from: the numbers ``observed`` in the environment, the
    true ``places``, the ``team``'s estimates, the number ``i`` of the agent that observes, and the
    environment."""

    observed: Float64[Tensor, "B k"]
    places: Float64[Tensor, "B N d"]
    team: Localization
    i: int
    env: Any


@dataclass(frozen=True)
class Entry(ABC):
    """Some numbers of an agent's observation: ``at`` which indices."""

    at: slice

    @abstractmethod
    def known(self, moment: Moment) -> Float64[Tensor, "B k"]:
        """What an agent that knows only estimates has in their place."""


@dataclass(frozen=True)
class Own(Entry):
    """The agent's own position or velocity."""

    quantity: Quantity = "position"

    def known(self, moment: Moment) -> Float64[Tensor, "B k"]:
        team = moment.team
        return (team.position if self.quantity == "position" else team.velocity)[:, moment.i]


@dataclass(frozen=True)
class ToThing(Entry):
    """From the agent to a thing whose place it knows, be it fixed or not: place − own position
    (``away=True``: own position − place)."""

    away: bool = False

    def known(self, moment: Moment) -> Float64[Tensor, "B k"]:
        sign = -1.0 if self.away else 1.0
        thing = sign * moment.observed + moment.places[:, moment.i]
        return sign * (thing - moment.team.position[:, moment.i])


@dataclass(frozen=True)
class ToAgent(Entry):
    """From the agent to agent number ``other``, as heard: its position (or velocity) − own one
    (``away=True``: own one − its)."""

    other: int
    quantity: Quantity = "position"
    away: bool = False

    def known(self, moment: Moment) -> Float64[Tensor, "B k"]:
        team, i = moment.team, moment.i
        heard = team.heard if self.quantity == "position" else team.heard_velocity
        apart = heard[:, i, self.other] - heard[:, i, i]
        return -apart if self.away else apart


@dataclass(frozen=True)
class Rays(Entry):
    """Distances along rays at ``angles`` (rad) to the nearest of round things, at most ``reach``
    (``closeness=True``: ``reach`` minus that): ``things(env, team, i)`` gives their centres
    [B, T, 2], as agent ``i`` knows them, and their radii [T]."""

    angles: Float[Tensor, "k"]
    reach: float
    things: Callable[[Any, Localization, int], tuple[Tensor, Tensor]]
    closeness: bool = False

    def known(self, moment: Moment) -> Float64[Tensor, "B k"]:
        own = moment.team.position[:, moment.i]
        centres, radii = self.things(moment.env, moment.team, moment.i)
        distance = cast_rays(own, self.angles, centres, radii).clamp(max=self.reach)
        return self.reach - distance if self.closeness else distance


def cast_rays(
    origin: Float[Tensor, "B 2"],
    angles: Float[Tensor, "k"],
    centres: Float[Tensor, "B T 2"],
    radii: Float[Tensor, "T"],
) -> Float64[Tensor, "B k"]:
    """How far it is along each ray to the first circle that it meets; inf where it meets none, 0
    from within one: t = c·u − √(r² − |c|² + (c·u)²), c from the origin to the circle's centre."""
    ray = torch.stack((angles.cos(), angles.sin()), -1).to(torch.float64)  # u
    centre = centres.to(torch.float64) - origin.unsqueeze(1)
    along = torch.einsum("btx,kx->bkt", centre, ray)
    gap = radii.to(torch.float64) ** 2 - (centre * centre).sum(-1)  # > 0 inside
    half = gap.unsqueeze(1) + along * along
    meets = (half >= 0) & (along >= 0)
    distance = torch.where(meets, along - half.clamp_min(0.0).sqrt(), torch.inf)
    distance = torch.where((gap > 0).unsqueeze(1), 0.0, distance)
    return distance.amin(-1)


def replaced(
    observation: Float[Tensor, "B F"],
    entries: Sequence[Entry],
    places: Float64[Tensor, "B N d"],
    team: Localization,
    i: int,
    env: Any,
) -> Float[Tensor, "B F"]:
    """Agent ``i``'s observation with estimates in place of the truth.

    Raises ValueError for an entry that lies outside it or has another width.
    """
    found = observation.clone()
    for entry in entries:
        part = observation[:, entry.at].to(torch.float64)
        known = entry.known(Moment(part, places, team, i, env))
        if not part.shape[1] or known.shape != part.shape:
            raise ValueError(
                f"Localized: {entry} of agent {i} has {known.shape[-1]} numbers, and "
                f"{entry.at} of an observation of {observation.shape[1]} is {part.shape[1]}"
            )
        found[:, entry.at] = known.to(found.dtype)
    return found
