"""The results of a study, by a cell's name and agent: runs, bounds, costs, whatever was planned."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from coloc_env.bounds import Bound
from training.evaluation.metrics import Flags, Floats
from training.evaluation.record import RunRecord, Worlds
from training.evaluation.results import Evaluation
from training.reproduce.settings import Settings
from training.reproduce.store import Arrays, Facts, Store
from training.reproduce.work import WORLD, Cell, Kind, Piece, Variant, load_posterior, resolve

Need = tuple[str, str] | tuple[str, str, Kind]  # a cell's name, an agent ("": none), and a kind


@dataclass(frozen=True, eq=False)
class Runs:
    """An agent's runs in a cell: R runs, K steps, N UAVs."""

    evaluation: Evaluation
    agent: str

    @property
    def record(self) -> RunRecord:
        return self.evaluation.agents[self.agent]

    @property
    def error(self) -> Floats:
        """[R, K, N] m."""
        return self.record.error

    @property
    def scored(self) -> Flags:
        """[R, K, N]."""
        return self.evaluation.worlds.scored

    @property
    def truth(self) -> Floats:
        """[R, K, N, d] m."""
        return self.evaluation.worlds.truth

    @property
    def steps(self) -> int:
        return self.error.shape[1]

    @property
    def dt(self) -> float:
        """Seconds a step."""
        return self.evaluation.dt

    @cached_property
    def diverged(self) -> int:
        """Runs that ended lost or not finite."""
        return int(self.evaluation.diverged(self.agent).sum())

    @property
    def summary(self) -> dict[str, Any]:
        """The agent's figures as ``coloc evaluate`` has them."""
        found: dict[str, Any] = self.evaluation.summary["agents"][self.agent]
        return found


class Results:
    """What is stored of ``cells``; ``every``: all of the study's, which decide how runs are
    divided into blocks, so that all tables share what they can. ``failed``: why there is nothing,
    by variant's key and subject."""

    def __init__(self, settings: Settings, cells: Iterable[Cell], every: Iterable[Cell]) -> None:
        self.settings, self.store = settings, Store(settings.store)
        self.cells: dict[str, list[Cell]] = {}
        for cell in sorted(cells, key=lambda cell: -cell.runs):
            there = self.cells.setdefault(cell.name, [])
            alike = (c for c in there if (c.kind, c.agents) == (cell.kind, cell.agents))
            if cell.kind is None or not any(alike):
                there.append(cell)  # a bound over more runs serves for fewer
        counts: dict[str, set[int]] = {}
        for cell in every:
            if cell.kind is None:
                counts.setdefault(cell.variant.key, set()).add(cell.runs)
        self._ends = {key: sorted(some) for key, some in counts.items()}
        self.failed: dict[tuple[str, str], str] = {}
        self._evaluations: dict[tuple[str, int], Evaluation] = {}

    # ---------------------------------------------------------------- what is to be computed

    def pieces(self) -> list[Piece]:
        """All pieces of all cells, once each; what cannot be built is noted in ``failed``."""
        found = [piece for cells in self.cells.values() for c in cells for piece in self._of(c)]
        return [piece for piece in dict.fromkeys(found) if self._can(piece)]

    def _of(self, cell: Cell) -> list[Piece]:
        if cell.kind is None:
            agents = (WORLD, *cell.agents)
            return [p for agent in agents for p in self._blocks(cell.variant, agent, cell.runs)]
        if cell.kind.together:
            able = self._able(cell)
            return [self._piece(cell, able)] if able else []
        return [self._piece(cell, (agent,)) for agent in cell.agents] or [self._piece(cell, ())]

    def _blocks(self, variant: Variant, agent: str, runs: int) -> list[Piece]:
        ends = [end for end in self._ends[variant.key] if end <= runs]
        return [
            Piece(
                variant,
                (agent,),
                self.settings.seed + start,
                end - start,
                device=self.settings.device,
            )
            for start, end in zip((0, *ends), ends, strict=False)
        ]

    def _piece(self, cell: Cell, agents: tuple[str, ...]) -> Piece:
        return Piece(cell.variant, agents, self.settings.seed, cell.runs, cell.kind)

    def _able(self, cell: Cell) -> tuple[str, ...]:
        ones = {agent: Piece(cell.variant, (agent,), 0, 1) for agent in cell.agents}
        return tuple(agent for agent, piece in ones.items() if self._can(piece))

    def _can(self, piece: Piece) -> bool:
        try:
            piece.settings()
        except (ValueError, OSError) as error:
            self.failed[piece.variant.key, piece.subject] = str(error)
            return False
        return True

    # ---------------------------------------------------------------- what there is

    def __getitem__(self, what: tuple[str, str]) -> Runs:
        """An agent's runs. Raises KeyError if there are none."""
        found = self.get(*what)
        if found is None:
            raise KeyError(what)
        assert isinstance(found, Runs)
        return found

    def get(self, name: str, agent: str = "", kind: Kind | None = None) -> Any:
        """An agent's ``Runs`` in a cell, or what there is of another kind; None: nothing."""
        own = WORLD if kind is None else ""  # what every cell of the kind has
        cells = [
            cell
            for cell in self.cells.get(name, ())
            if cell.kind == kind and agent in (own, *cell.agents)
        ]
        if not cells:
            return None
        most = max(cells, key=lambda cell: cell.runs)
        if kind is None:
            if {(most.variant.key, WORLD), (most.variant.key, agent)} & self.failed.keys():
                return None
            return Runs(self.evaluation(name, most.runs), agent)
        alone = (agent,) if agent else ()
        piece = self._piece(most, self._able(most) if kind.together else alone)
        if (not piece.agents and most.agents) or (most.variant.key, piece.subject) in self.failed:
            return None
        found = resolve(kind.load)(most.variant, *piece.load(self.store))
        return found.get(agent) if kind.together else found

    def runs(self, name: str, agents: Sequence[str] | None = None) -> dict[str, Runs]:
        """By agent (None: all of the cell, dead reckoning first)."""
        if agents is None:
            agents = self.agents(name)
        there = {agent: self.get(name, agent) for agent in agents}
        return {agent: one for agent, one in there.items() if one is not None}

    def agents(self, name: str) -> list[str]:
        """All that are planned in a cell, dead reckoning first."""
        cells = (cell for cell in self.cells.get(name, ()) if cell.kind is None)
        return list(dict.fromkeys((WORLD, *(agent for cell in cells for agent in cell.agents))))

    def kinds(self, name: str, kind: Kind) -> dict[str, Any]:
        """What there is of another kind, by agent."""
        agents = (a for cell in self.cells.get(name, ()) if cell.kind == kind for a in cell.agents)
        found = {agent: self.get(name, agent, kind) for agent in agents}
        return {agent: one for agent, one in found.items() if one is not None}

    def variant(self, name: str) -> Variant:
        """Of a cell that is asked for."""
        return self.cells[name][0].variant

    def evaluation(self, name: str, runs: int) -> Evaluation:
        """All agents with so many runs in a cell; those that failed are left out."""
        if (name, runs) not in self._evaluations:
            self._evaluations[name, runs] = self._loaded(name, runs)
        return self._evaluations[name, runs]

    def _loaded(self, name: str, runs: int) -> Evaluation:
        variant = self.variant(name)
        worlds = [piece.load(self.store) for piece in self._blocks(variant, WORLD, runs)]
        met = Worlds.cat([Worlds.from_arrays(self.settings.seed, arrays) for arrays, _ in worlds])
        starts = [facts["start"] for _, facts in worlds]
        found = {}
        for agent in self.agents(name):
            if (variant.key, agent) in self.failed or self._count(name, agent) < runs:
                continue
            blocks = [piece.load(self.store) for piece in self._blocks(variant, agent, runs)]
            if [facts["start"] for _, facts in blocks] != starts:
                raise ValueError(f"{variant.key}: {agent} met other worlds than the bound")
            parts = [RunRecord.from_arrays(met, arrays, facts) for arrays, facts in blocks]
            found[agent] = RunRecord.cat(parts, met)
        return Evaluation(variant.build(), met, _bound(variant, worlds), found)

    def _count(self, name: str, agent: str) -> int:
        cells = (cell for cell in self.cells[name] if cell.kind is None)
        return max((c.runs for c in cells if agent in (WORLD, *c.agents)), default=0)

    def summaries(self) -> dict[str, Any]:
        """All figures of every cell, as ``coloc evaluate`` has them, by the cell's name."""
        found: dict[str, Any] = {}
        for name in self.cells:
            for agent, one in self.runs(name).items():
                whole = one.evaluation.summary
                start = {key: whole[key] for key in ("scenario", "overrides", "steps", "bound")}
                there = found.setdefault(name, start | {"agents": {}})
                there["agents"][agent] = one.summary | {"runs": whole["runs"]}
        return found


def _bound(variant: Variant, worlds: Sequence[tuple[Arrays, Facts]]) -> Bound | None:
    """The bound of all blocks; None if the worlds have none."""
    if any("bound_mse" not in arrays for arrays, _ in worlds):
        return None
    joined: Mapping[str, Any] = {
        key: np.concatenate([arrays[key] for arrays, _ in worlds])
        for key in ("bound_mse", "bound_scored")
    }
    return load_posterior(variant, dict(joined), {})
