"""Single runs whose links are recorded: what weight each had, and how fast feedback moves it.

What a localizer gives its links is no part of its estimate, so these runs are recorded here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float64
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from agents.registry import make
from agents.swarm.belief import StepInput
from agents.swarm.confidence import Weights
from agents.swarm.filter import SwarmFilter
from coloc_env.geometry.walls import depth
from training.evaluation.metrics import Flags, Floats
from training.evaluation.rollout import rollout

if TYPE_CHECKING:
    from training.evaluation.evaluate import Progress
    from training.reproduce.store import Arrays, Facts
    from training.reproduce.work import Piece, Variant

LOW = 0.2  # weight below which the paper calls a link cut off
_APART = 5.0  # s without NLOS that end an event


@dataclass(frozen=True, eq=False)
class Links:
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

    def event(self) -> Event | None:
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

    def fall(self, event: Event) -> float:
        """Seconds from an event's first range until the link's weight is below ``LOW``; infinity if
        it never is while the event lasts."""
        weight = self.weight[event.first : event.last + 1, event.i, event.j]
        measured = np.isfinite(self.range[event.first : event.last + 1, event.i, event.j])
        low = np.flatnonzero(measured & (weight < LOW))
        return self.dt * float(low[0]) if len(low) else float("inf")

    def peak(self, event: Event) -> float:
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


def record_links(piece: Piece, progress: Progress) -> tuple[Arrays, Facts]:
    """A run with what happens on every link."""
    scenario, (agent,) = piece.variant.build(), piece.agents
    steps, n = scenario.horizon, scenario.arena.n_uavs
    localizer = make(agent, scenario)
    weights = _Weights(localizer)
    arrays = {key: np.full((steps, n, n), np.nan) for key in ("length", "range", "weight")}
    arrays["blocked"] = np.zeros((steps, n, n), bool)
    arrays["error"] = np.zeros((steps, n))
    for step in rollout(localizer, scenario, torch.tensor([piece.seed])):
        k, truth = step.k, step.world.truth.position[0]
        there = step.observation["range_mask"][0].numpy() > 0
        arrays["range"][k] = np.where(there, step.observation["ranges"][0].numpy(), np.nan)
        arrays["length"][k] = torch.cdist(truth, truth).numpy()
        arrays["blocked"][k] = depth(truth.unsqueeze(1), truth, scenario.network.walls).numpy() > 0
        arrays["weight"][k] = weights.last[:n, :n]
        assert step.estimate is not None
        arrays["error"][k] = (step.estimate.position[0] - truth).norm(dim=-1).numpy()
        progress(agent, k + 1, steps)
    arrays["error"][:, : scenario.anchor_uavs] = np.nan
    return arrays, {}


def load_links(variant: Variant, arrays: Arrays, facts: Facts) -> Links:
    """What ``record_links`` made."""
    return Links(**arrays, dt=variant.build().arena.dt)


def record_loop(piece: Piece, progress: Progress) -> tuple[Arrays, Facts]:
    """A run of an agent that feeds confidences back: how they change."""
    scenario, (agent,) = piece.variant.build(), piece.agents
    change, mean = np.zeros(scenario.horizon), np.zeros(scenario.horizon)
    localizer, seeds = make(agent, scenario), torch.tensor([piece.seed])
    before: Any = None
    for step in rollout(localizer, scenario, seeds):
        if before is None:
            before = localizer.reset(step.observation)
        confidence = step.belief.confidence
        change[step.k] = float((confidence / before.confidence - 1).abs().max())
        mean[step.k] = float(confidence[step.observation["range_mask"] > 0].mean())
        before = step.belief
        progress(agent, step.k + 1, scenario.horizon)
    return {"change": change, "mean": mean}, {}


def load_loop(variant: Variant, arrays: Arrays, facts: Facts) -> Loop:
    """What ``record_loop`` made."""
    return Loop(**arrays)


class _Weights:
    """Keeps the last weights that a swarm filter, or the one inside a loop, gave its links."""

    def __init__(self, localizer: Any) -> None:
        base: SwarmFilter = getattr(localizer, "base", localizer)
        weights, variance = base.weights_at, base.std**2
        self.last: Floats = np.zeros((0, 0))

        def recorded(residual: Float64[Tensor, "B *L"], inputs: StepInput) -> Weights:
            weight, shift = weights(residual, inputs)
            pairs = inputs.links.listed
            whole = weight if pairs is None else pairs.matrix(weight.unsqueeze(1))
            self.last = variance * whole[0].numpy()
            return weight, shift

        base.weights_at = recorded  # type: ignore[method-assign]
