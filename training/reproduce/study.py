"""Agents in variants of scenarios: what is to be flown, and the results put together again.

A piece of work is one agent in one variant over a block of seeds, or (agent ``WORLD``) the worlds
themselves, with their bound unless the variant says otherwise, or a bound alone (``BOUNDS``), which
may take longer than all flights and need fewer runs. More runs of the same are another block, so
that tables over 20 runs and a figure over 30 share what they can; and whatever was computed for one
table serves all.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any

import numpy as np
import torch

from agents.registry import make
from coloc_env.bounds import Bound, SnapshotBound, posterior_bound, snapshot_bound
from coloc_env.options import require_known
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from training.evaluation.evaluate import Progress, evaluate, silent
from training.evaluation.record import RunRecord, Worlds
from training.evaluation.results import Evaluation
from training.reproduce.identity import code_of, weights_of
from training.reproduce.store import Arrays, Store

WORLD = "dead_reckoning"  # flown with the bound, for the worlds' truth: it applies to all of them
BOUNDS: dict[str, Callable[[Scenario, int, int], Bound]] = {
    "posterior_bound": posterior_bound,
    "snapshot_bound": snapshot_bound,
}


@dataclass(frozen=True)
class Variant:
    """A scenario with some overrides, known by ``key``; at most ``steps`` long. ``bounded``:
    its worlds are flown with their posterior bound."""

    key: str
    title: str
    overrides: tuple[tuple[str, Any], ...] = ()
    scenario: str = "indoor-v0"
    steps: int | None = None
    bounded: bool = True

    def build(self) -> Scenario:
        """ValueError or OSError where it cannot be (recordings that are not there)."""
        return _built(self)


Planned = tuple[Variant, tuple[str, ...], int]  # who flies there, and how often


@dataclass(frozen=True)
class Piece:
    """One agent in the worlds of ``runs`` seeds from ``seed`` on."""

    variant: Variant
    agent: str
    seed: int
    runs: int

    @property
    def name(self) -> str:
        agent = self.agent.replace("/", "_")  # options may hold paths
        return f"{self.variant.key}/{agent}-{self.seed}+{self.runs}"

    @property
    def size(self) -> int:
        """Steps of all runs."""
        return self.runs * self.variant.build().horizon

    def settings(self) -> dict[str, Any]:
        """All that the result depends on. ValueError if the agent cannot serve the scenario."""
        return _settings(self)


@lru_cache(maxsize=8)
def _built(variant: Variant) -> Scenario:
    built = make_scenario(variant.scenario, **dict(variant.overrides))
    steps = built.horizon if variant.steps is None else min(variant.steps, built.horizon)
    return replace(built, horizon=steps)


@cache
def _settings(piece: Piece) -> dict[str, Any]:
    scenario = piece.variant.build()
    localizer = make(WORLD if piece.agent in BOUNDS else piece.agent, scenario)
    return {
        "scenario": scenario.name,
        "overrides": dict(piece.variant.overrides),
        "steps": scenario.horizon,
        "seed": piece.seed,
        "runs": piece.runs,
        "agent": piece.agent,
        "bounded": piece.variant.bounded,
        "weights": weights_of(localizer),
        "code": code_of(localizer),
        "torch": str(torch.__version__),
    }


def compute(piece: Piece, store: Store, progress: Progress = silent) -> None:
    """Fly a piece, or compute a bound, and store what came of it."""
    settings = piece.settings()
    scenario, of_world = piece.variant.build(), piece.agent == WORLD
    if piece.agent in BOUNDS:
        known = BOUNDS[piece.agent](scenario, piece.runs, piece.seed)
        store.save(piece.name, settings, _bound_arrays(known), {})
        return
    with_bound = of_world and piece.variant.bounded
    found = evaluate(scenario, [piece.agent], piece.runs, piece.seed, progress, bound=with_bound)
    arrays, facts = found.agents[piece.agent].to_arrays()
    if of_world:
        arrays |= found.worlds.to_arrays()
        if found.bound is not None:
            arrays |= _bound_arrays(found.bound)
    store.save(piece.name, settings, arrays, facts | {"start": found.worlds.truth[:, 0].tolist()})


def _bound_arrays(known: Bound) -> Arrays:
    return {"bound_mse": known.mse.numpy(), "bound_scored": known.scored.numpy()}


class Study:
    """What a store holds of agents in variants over the same seeds."""

    def __init__(self, store: Store, seed: int) -> None:
        self.store, self.seed = store, seed
        self.failed: dict[tuple[str, str], str] = {}  # (variant's key, agent): why

    def pieces(self, variant: Variant, agent: str, *blocks: int) -> list[Piece]:
        """Blocks of so many runs each, one after the other."""
        starts = np.cumsum((0, *blocks[:-1])).tolist()
        return [
            Piece(variant, agent, self.seed + start, runs)
            for start, runs in zip(starts, blocks, strict=True)
        ]

    def chosen(
        self,
        planned: Sequence[Planned],
        where: Sequence[str] | None,
        agents: Sequence[str] | None = None,
    ) -> list[Piece]:
        """The pieces of a plan in the variants ``where``, of these agents (None: all); the rest is
        noted in ``failed``. Raises ValueError for a variant that is not in the plan."""
        require_known("variant", where, dict.fromkeys(variant.key for variant, _, _ in planned))
        found: list[Piece] = []
        for variant, able, count in planned:
            if where is not None and variant.key not in where:
                self.failed[variant.key, WORLD] = "not asked for"
                continue
            for agent in (WORLD, *able):
                pieces = self.pieces(variant, agent, count)
                if agents is None or agent in (WORLD, *agents):
                    found += pieces
                else:
                    self.do_without(pieces)
        return found

    def missing(self, pieces: Sequence[Piece]) -> list[Piece]:
        """Those not computed yet, once each. Where the scenario cannot be built, or the agent does
        not serve it, that is noted in ``failed``."""
        left = []
        for piece in dict.fromkeys(pieces):
            try:
                if not self.store.has(piece.name, piece.settings()):
                    left.append(piece)
            except (ValueError, OSError) as error:
                self.failed[piece.variant.key, piece.agent] = str(error)
        return left

    def do_without(self, pieces: Sequence[Piece]) -> None:
        """Note in ``failed`` what has not been computed."""
        for piece in self.missing(pieces):
            self.failed[piece.variant.key, piece.agent] = "not flown"

    def can(self, variant: Variant) -> bool:
        """Whether the variant's worlds are there."""
        return (variant.key, WORLD) not in self.failed

    def results(self, variant: Variant, agents: Sequence[str], *runs: int) -> Evaluation:
        """All agents that did not fail, over all blocks of ``runs``."""
        scenario = variant.build()
        worlds = [self._load(piece) for piece in self.pieces(variant, WORLD, *runs)]
        first = worlds[0][0]
        bound = None
        if "bound_mse" in first:
            mse, scored = (
                torch.from_numpy(_joined(worlds, f"bound_{key}")) for key in ("mse", "scored")
            )
            bound = Bound(mse, scored, scenario.arena.dt)
        starts = [facts["start"] for _, facts in worlds]
        met = Worlds.cat([Worlds.from_arrays(self.seed, arrays) for arrays, _ in worlds])
        found = {}
        for agent in agents:
            if (variant.key, agent) in self.failed:
                continue
            blocks = [self._load(piece) for piece in self.pieces(variant, agent, *runs)]
            if [facts["start"] for _, facts in blocks] != starts:
                raise ValueError(f"{variant.key}: {agent} met other worlds than the bound")
            parts = [RunRecord.from_arrays(met, arrays, facts) for arrays, facts in blocks]
            found[agent] = RunRecord.cat(parts, met)
        return Evaluation(scenario, met, bound, found)

    def bound(self, variant: Variant, which: str, runs: int) -> Bound | None:
        """One of ``BOUNDS`` over the first ``runs`` runs; None if it could not be computed."""
        if (variant.key, which) in self.failed:
            return None
        (piece,) = self.pieces(variant, which, runs)
        arrays, _ = self._load(piece)
        kind = SnapshotBound if which == "snapshot_bound" else Bound
        mse, scored = (torch.from_numpy(arrays[f"bound_{key}"]) for key in ("mse", "scored"))
        return kind(mse, scored, variant.build().arena.dt)

    def _load(self, piece: Piece) -> tuple[Arrays, dict[str, Any]]:
        return self.store.load(piece.name, piece.settings())


Loaded = Sequence[tuple[Arrays, dict[str, Any]]]


def _joined(blocks: Loaded, key: str) -> np.ndarray:
    return np.concatenate([arrays[key] for arrays, _ in blocks])
