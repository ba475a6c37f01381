"""Single runs in which links are looked at: what weight each had, and how fast feedback moves it.

What a localizer gives its links is no part of its estimate, so these runs are flown by themselves.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from agents.localizer import Localizer
from agents.registry import make
from agents.swarm.filter import SwarmFilter
from coloc_env.geometry.walls import depth
from coloc_env.world import World
from training.evaluation.evaluate import Progress
from training.evaluation.metrics import Flags, Floats
from training.reproduce.identity import code_of
from training.reproduce.store import Arrays, Store
from training.reproduce.study import Piece, Variant

LOW = 0.2  # weight below which the paper calls a link cut off
_APART = 5.0  # s without NLOS that end an event


@dataclass(frozen=True, eq=False)
class Watched:
    """A run of K steps of N UAVs: ``error`` [K, N] m, NaN of anchors; between all pairs [K, N, N]
    the true ``length`` m, whether a wall is between (``blocked``), the ``range`` m (NaN: none), and
    the ``weight`` of the link as a multiple of that of a range with the believed noise; ``dt`` s.
    """

    error: Floats
    length: Floats
    blocked: Flags
    range: Floats
    weight: Floats
    dt: float

    @property
    def components(self) -> NDArray[np.int64]:
        """[K]: parts of the network that ranges leave unconnected."""
        linked = np.isfinite(self.range)
        return np.array([connected_components(each, directed=False)[0] for each in linked])

    def event(self) -> "Event | None":
        """Of all times that a wall came between two UAVs which had measured each other before, that
        with the most ranges; None if there is none. Links between anchors do not count."""
        known, apart = np.isfinite(self.range), max(1, round(_APART / self.dt))
        anchor: Flags = np.asarray(np.isnan(self.error).all(axis=0))
        best, count = None, 0
        for i, j in zip(*np.triu_indices(len(anchor), 1), strict=True):
            steps = np.flatnonzero(
                known[:, i, j] & self.blocked[:, i, j] & ~(anchor[i] & anchor[j])
            )
            for part in np.split(steps, np.flatnonzero(np.diff(steps) > apart) + 1):
                if len(part) <= count:
                    continue
                before = slice(max(0, part[0] - apart), part[0])
                if known[before, i, j].sum() >= apart // 2:
                    best, count = (int(i), int(j), int(part[0]), int(part[-1])), len(part)
        return None if best is None else Event(*best)

    def fall(self, event: "Event") -> float:
        """Seconds from an event's first range until the link's weight is below ``LOW``; infinity if
        it never is while the event lasts."""
        weight = self.weight[event.first : event.last + 1, event.i, event.j]
        measured = np.isfinite(self.range[event.first : event.last + 1, event.i, event.j])
        low = np.flatnonzero(measured & (weight < LOW))
        return self.dt * float(low[0]) if len(low) else float("inf")

    def peak(self, event: "Event") -> float:
        """Largest error (m) of an event's UAVs from its first range to 5 s after its last."""
        last = event.last + max(1, round(_APART / self.dt))
        return float(np.nanmax(self.error[event.first : last + 1, [event.i, event.j]]))


@dataclass(frozen=True)
class Event:
    """The link between UAVs ``i`` and ``j`` from the ``first`` to the ``last`` step with NLOS."""

    i: int
    j: int
    first: int
    last: int


@dataclass(frozen=True, eq=False)
class Loop:
    """How fed-back confidences change: the largest ``change`` of a link in each step [K], as a
    share, and the ``mean`` confidence [K] of the links."""

    change: Floats
    mean: Floats


def watched(
    store: Store, variant: Variant, agent: str, seed: int, tell: Progress, missing: bool
) -> Watched | None:
    """A run, from the store if it is there; None if it is not and nothing is ``missing``."""
    found = _stored(store, "links", variant, agent, seed, tell, missing)
    return None if found is None else Watched(**found, dt=variant.build().arena.dt)


def loop(
    store: Store, variant: Variant, agent: str, seed: int, tell: Progress, missing: bool
) -> Loop | None:
    """The same for an agent that feeds confidences back."""
    found = _stored(store, "loop", variant, agent, seed, tell, missing)
    return None if found is None else Loop(**found)


def _stored(
    store: Store, kind: str, variant: Variant, agent: str, seed: int, tell: Progress, missing: bool
) -> Arrays | None:
    piece = Piece(variant, agent, seed, 1)
    localizer = make(agent, variant.build())
    name = f"{piece.name}-{kind}"
    settings = piece.settings() | {"code": code_of(localizer, "training.reproduce.stdcl.links")}
    if not store.has(name, settings):
        if not missing:
            return None
        look = {"links": _fly_links, "loop": _fly_loop}[kind]
        store.save(name, settings, look(localizer, variant, seed, tell), {})
    arrays, _ = store.load(name, settings)
    return arrays


@torch.no_grad()
def _fly_links(localizer: Localizer, variant: Variant, seed: int, tell: Progress) -> Arrays:
    scenario = variant.build()
    steps, n = scenario.horizon, scenario.arena.n_uavs
    world = World(scenario)
    observation = world.reset(seed)
    belief, weights = localizer.reset(observation), _Weights(localizer)
    arrays = {key: np.full((steps, n, n), np.nan) for key in ("length", "range", "weight")}
    arrays["blocked"] = np.zeros((steps, n, n), bool)
    arrays["error"] = np.zeros((steps, n))
    for k in range(steps):
        belief, estimate = localizer.step(belief, observation)
        there = observation["range_mask"][0].numpy() > 0
        arrays["range"][k] = np.where(there, observation["ranges"][0].numpy(), np.nan)
        truth = world.truth.position[0]
        arrays["length"][k] = torch.cdist(truth, truth).numpy()
        arrays["blocked"][k] = depth(truth.unsqueeze(1), truth, scenario.network.walls).numpy() > 0
        arrays["weight"][k] = weights.last[:n, :n]
        arrays["error"][k] = (estimate.position[0] - truth).norm(dim=-1).numpy()
        world.advance(estimate.action())
        observation = world.observation()
        tell("links", k + 1, steps)
    arrays["error"][:, : scenario.anchor_uavs] = np.nan
    return arrays


@torch.no_grad()
def _fly_loop(localizer: Localizer, variant: Variant, seed: int, tell: Progress) -> Arrays:
    scenario = variant.build()
    world = World(scenario)
    observation = world.reset(seed)
    belief: Any = localizer.reset(observation)
    change, mean = np.zeros(scenario.horizon), np.zeros(scenario.horizon)
    for k in range(scenario.horizon):
        before = belief.confidence
        belief, estimate = localizer.step(belief, observation)
        change[k] = float((belief.confidence / before - 1).abs().max())
        mean[k] = float(belief.confidence[observation["range_mask"] > 0].mean())
        world.advance(estimate.action())
        observation = world.observation()
        tell("loop", k + 1, scenario.horizon)
    return {"change": change, "mean": mean}


class _Weights:
    """Listens to the weights that a swarm filter, or the one inside a loop, gives its links."""

    def __init__(self, localizer: Any) -> None:
        base: SwarmFilter = getattr(localizer, "base", localizer)
        weigh, variance = base.weigh, base.std**2
        self.last: Floats = np.zeros((0, 0))

        def heard(*given: Any) -> tuple[Float64[Tensor, "B N N"], Float64[Tensor, "B N N"]]:
            weight, shift = weigh(*given)
            self.last = variance * weight[0].numpy()
            return weight, shift

        base.weigh = heard  # type: ignore[method-assign, assignment]
