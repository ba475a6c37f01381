"""Units of work: pieces of a study, each stored in a file of its own, and trainings."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from agents.registry import make
from coloc_env.bounds import Bound, SnapshotBound, posterior_bound, snapshot_bound
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from training.evaluation.evaluate import Progress, evaluate, silent
from training.identity import code_of, weights_of
from training.reproduce.store import Arrays, Facts, Store

WORLD = "dead_reckoning"  # run with the bound, for the worlds' truth: it applies to all of them


@dataclass(frozen=True)
class Variant:
    """A scenario with some overrides, known by ``key``; at most ``steps`` long. ``bounded``: its
    worlds are run with their posterior bound."""

    key: str
    title: str
    overrides: tuple[tuple[str, Any], ...] = ()
    scenario: str = "indoor-v0"
    steps: int | None = None
    bounded: bool = True

    def build(self) -> Scenario:
        """ValueError or OSError where it cannot be (recordings that are not there)."""
        return _built(self)


@lru_cache(maxsize=8)
def _built(variant: Variant) -> Scenario:
    built = make_scenario(variant.scenario, **dict(variant.overrides))
    steps = built.horizon if variant.steps is None else min(variant.steps, built.horizon)
    return replace(built, horizon=steps)


@dataclass(frozen=True)
class Kind:
    """What a piece holds. ``compute``: "module:function" of a piece and progress, which returns
    arrays and facts; ``load``: the same of a variant, arrays and facts, which returns what they
    are. ``code``: modules that it runs beside those of agents and worlds. ``together``: all agents
    in one piece, with nothing else running (timings)."""

    label: str
    compute: str
    load: str
    code: tuple[str, ...] = ()
    together: bool = False


@dataclass(frozen=True)
class Cell:
    """A line of a plan: ``agents`` in the first ``runs`` worlds of a variant, all known by ``name``
    (default: the variant's key)."""

    variant: Variant
    agents: tuple[str, ...] = ()
    runs: int = 1
    kind: Kind | None = None  # None: simulated runs
    key: str = ""

    @property
    def name(self) -> str:
        return self.key or self.variant.key


@dataclass(frozen=True)
class Piece:
    """A unit of work: agents in the worlds of ``runs`` seeds from ``seed`` on; no agents: the
    worlds themselves (bounds). ``device``: where simulated runs are; kinds are on the CPU."""

    variant: Variant
    agents: tuple[str, ...]
    seed: int
    runs: int
    kind: Kind | None = None
    device: str = "cpu"

    @property
    def name(self) -> str:
        agents = "+".join(self.agents) if self.kind is None or not self.kind.together else ""
        label = "" if self.kind is None else self.kind.label
        what = "-".join(filter(None, (agents.replace("/", "_"), label)))  # options may hold paths
        return f"{self.variant.key}/{what}-{self.seed}+{self.runs}"

    @property
    def subject(self) -> str:
        """Agents, or what else is computed, in words."""
        return ", ".join(self.agents) or (self.kind.label if self.kind else "")

    @property
    def size(self) -> int:
        """Steps of all runs."""
        return self.runs * self.variant.build().horizon

    def settings(self) -> dict[str, Any]:
        """All that the result depends on. ValueError if an agent cannot serve the scenario."""
        return _settings(self)

    def done(self, out: Path) -> bool:
        """Whether it is stored under an output folder."""
        return _store(out).has(self.name, self.settings())

    def run(self, progress: Callable[[int], None]) -> tuple[Arrays, Facts]:
        """Compute it, on one thread; ``progress`` is given steps as they are done."""
        torch.set_num_threads(1)
        before = 0

        def steps_done(what: str, done: int, total: int) -> None:
            nonlocal before
            if what in self.agents:
                progress(done - before)
                before = done

        compute = resolve(self.kind.compute if self.kind else _RUN)
        found: tuple[Arrays, Facts] = compute(self, steps_done)
        progress(self.size - before)
        return found

    def keep(self, out: Path, found: tuple[Arrays, Facts]) -> None:
        """Store what ``run`` returned under an output folder."""
        _store(out).save(self.name, self.settings(), *found)

    def load(self, store: Store) -> tuple[Arrays, Facts]:
        """What was stored."""
        return store.load(self.name, self.settings())


@dataclass(frozen=True)
class Training:
    """A training run, ``coloc train TRAINING --set …``, in a folder of its own, known by ``key``;
    resumed where it stopped. ``options`` as pairs."""

    key: str
    training: str
    options: tuple[tuple[str, Any], ...] = ()

    def folder(self, out: Path) -> Path:
        """Its run's folder."""
        return (out / "runs" / self.key).absolute()

    def done(self, out: Path) -> bool:
        """Whether the weights are there."""
        return (self.folder(out) / f"{self.training}.json").exists()


@dataclass(frozen=True)
class TrainingRun:
    """A training as a unit of work, in ``folder``, which every worker must see."""

    training: Training
    folder: Path
    size: int = 1

    @property
    def name(self) -> str:
        return f"training {self.training.key}"

    def settings(self) -> dict[str, Any]:
        """What decides the run, as it is to be in a worker."""
        one = self.training
        return {"training": one.training, "options": dict(one.options), "folder": str(self.folder)}

    def run(self, progress: Callable[[int], None]) -> None:
        """Train, or go on where it stopped, on one thread."""
        from training.learning import run as trainings

        torch.set_num_threads(1)
        if (self.folder / "run.json").exists():
            trainings.resume(self.folder, silent)
        else:
            options = dict(self.training.options)
            trainings.start(self.training.training, options, self.folder, silent)
        progress(self.size)

    def keep(self, out: Path, found: None) -> None:
        """OSError unless the weights that a worker wrote are here."""
        if not self.training.done(out):
            raise OSError(f"{self.folder} is not on a file system that all workers share")


Unit = Piece | TrainingRun


def resolve(reference: str) -> Callable[..., Any]:
    """A function by "module:function"."""
    module, _, name = reference.partition(":")
    found: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return found


def _store(out: Path) -> Store:
    return Store(out / "store")


@cache
def _settings(piece: Piece) -> dict[str, Any]:
    scenario = piece.variant.build()
    localizers = [make(agent, scenario) for agent in piece.agents]
    modules = ("training.evaluation.record", *(piece.kind.code if piece.kind else ()))
    return {
        "scenario": scenario.name,
        "overrides": dict(piece.variant.overrides),
        "steps": scenario.horizon,
        "seed": piece.seed,
        "runs": piece.runs,
        "agents": list(piece.agents),
        "kind": piece.kind.label if piece.kind else "",
        "bounded": piece.variant.bounded,
        "weights": [weights_of(localizer) for localizer in localizers],
        "code": code_of(piece.variant.scenario, localizers, modules),
        "torch": str(torch.__version__),
        **({} if piece.device == "cpu" else {"device": piece.device}),
    }


# ------------------------------------------------------------------ what pieces hold


_RUN = f"{__name__}:run_agent"


def run_agent(piece: Piece, progress: Progress) -> tuple[Arrays, Facts]:
    """One agent's record; of ``WORLD`` with the worlds, and their bound where the variant has
    one."""
    scenario, (agent,) = piece.variant.build(), piece.agents
    of_world = agent == WORLD
    bound = of_world and piece.variant.bounded
    where = piece.device
    found = evaluate(scenario, [agent], piece.runs, piece.seed, progress, bound=bound, device=where)
    arrays, facts = found.agents[agent].to_arrays()
    if of_world:
        arrays |= found.worlds.to_arrays()
        if found.bound is not None:
            arrays |= bound_arrays(found.bound)
    return arrays, facts | {"start": found.worlds.truth[:, 0].tolist()}


def compute_posterior(piece: Piece, progress: Progress) -> tuple[Arrays, Facts]:
    """The posterior bound, which may take longer than all runs and need fewer of them."""
    return bound_arrays(posterior_bound(piece.variant.build(), piece.runs, piece.seed)), {}


def compute_snapshot(piece: Piece, progress: Progress) -> tuple[Arrays, Facts]:
    """The bound from one step's measurements alone."""
    return bound_arrays(snapshot_bound(piece.variant.build(), piece.runs, piece.seed)), {}


def bound_arrays(bound: Bound) -> Arrays:
    """As they are stored."""
    return {"bound_mse": bound.mse.numpy(), "bound_scored": bound.scored.numpy()}


def load_posterior(variant: Variant, arrays: Arrays, facts: Facts) -> Bound:
    """What ``bound_arrays`` made."""
    mse, scored = (torch.from_numpy(np.array(arrays[f"bound_{x}"])) for x in ("mse", "scored"))
    return Bound(mse, scored, variant.build().arena.dt)


def load_snapshot(variant: Variant, arrays: Arrays, facts: Facts) -> SnapshotBound:
    """The same, of a snapshot."""
    bound = load_posterior(variant, arrays, facts)
    return SnapshotBound(bound.mse, bound.scored, bound.dt)


POSTERIOR = Kind("posterior_bound", f"{__name__}:compute_posterior", f"{__name__}:load_posterior")
SNAPSHOT = Kind("snapshot_bound", f"{__name__}:compute_snapshot", f"{__name__}:load_snapshot")
