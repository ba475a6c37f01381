"""A study as data, and the machine that runs it: plan, results, verdicts, figures, page."""

from __future__ import annotations

import platform
import shutil
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from shlex import quote
from typing import Any

from agents.registry import LOCALIZERS
from coloc_env.options import require_known
from coloc_env.registry import Registry
from coloc_env.staging import staged_folder
from training import pool
from training.evaluation.evaluate import Progress, silent
from training.evaluation.results import plain
from training.reproduce import page, verdicts
from training.reproduce.cost import COST, Cost
from training.reproduce.drawing import Drawing, draw
from training.reproduce.results import Results
from training.reproduce.settings import Settings
from training.reproduce.tables import Table
from training.reproduce.verdicts import Claim, Goal
from training.reproduce.work import Cell, Piece, Training, TrainingRun, Unit

STUDIES = Registry(
    "study",
    "coloc.studies",
    {
        "cspf": "training.reproduce.cspf:cspf",
        "marl": "training.reproduce.marl:marl",
        "nnhpff": "training.reproduce.nnhpff:nnhpff",
        "pfnn": "training.reproduce.pfnn:pfnn",
        "stdcl": "training.reproduce.stdcl:stdcl",
    },
)
FILES = ("results.json", "page.md")  # beside the figures
_VERSIONS = ("torch", "numpy")


def _none(_: Any) -> Iterable[Any]:
    return ()


@dataclass(frozen=True)
class Part:
    """A part of a study: what is planned, claimed, to be reached, tabulated and drawn.

    ``trainings``: what must be trained before ``cells`` can run. ``figures`` by file name.
    """

    title: str
    cells: Callable[[Settings], Iterable[Cell]]
    text: Callable[[Settings], Iterable[str]] = _none
    claims: Callable[[Settings], Iterable[Claim]] = _none
    goals: Callable[[Settings], Iterable[Goal]] = _none
    tables: Callable[[Results], Iterable[Table]] = _none
    figures: Mapping[str, Drawing] = field(default_factory=dict)
    trainings: Callable[[Settings], Iterable[Training]] = _none


@dataclass(frozen=True)
class Study:
    """A paper (or another question): its ``name`` in the registry and in words, where it was
    published, how many ``runs`` its main tables have, and its parts."""

    key: str
    name: str
    source: str
    runs: int
    parts: Mapping[str, Part]

    def chosen(self, settings: Settings) -> list[Part]:
        """The parts asked for. ValueError for one that does not exist."""
        if settings.part != "all" and settings.part not in self.parts:
            allowed = ", ".join((*self.parts, "all"))
            raise ValueError(f"{self.key} has no part {settings.part!r}: {allowed} are allowed")
        return [part for key, part in self.parts.items() if settings.part in (key, "all")]

    @property
    def files(self) -> tuple[str, ...]:
        """All that may be written."""
        return (*(name for part in self.parts.values() for name in part.figures), *FILES)


def reproduce(
    study: Study,
    settings: Settings,
    progress: Progress = silent,
    report: Callable[[str], None] = lambda line: None,
) -> None:
    """Compute what the store in ``settings.out`` lacks, then write the results there.

    ``report`` is given a line for every unit of work that is done.
    """
    parts = study.chosen(settings)
    every = [cell for part in study.parts.values() for cell in part.cells(settings)]
    cells = _asked([cell for part in parts for cell in part.cells(settings)], settings)
    trainings = [training for part in parts for training in part.trainings(settings)]
    _try_folder(settings.out, study.files)
    if settings.fresh:
        shutil.rmtree(settings.store, ignore_errors=True)
    results = Results(settings, cells, every)
    if settings.report_only:
        if results.store.empty():
            raise ValueError(f"{settings.store} holds nothing yet: run without --report-only first")
    else:
        left = [one for one in trainings if not one.done(settings.out)]
        runs = [TrainingRun(one, one.folder(settings.out)) for one in left]
        _run(runs, "trainings", settings, progress, report)
    pieces = [piece for piece in results.pieces() if not piece.done(settings.out)]
    if settings.report_only:
        _note(results, [(piece, "not run") for piece in pieces])
    else:
        timed = [piece for piece in pieces if piece.kind is not None and piece.kind.together]
        others = [piece for piece in pieces if piece not in timed]
        for (_, subject), why in results.failed.items():
            report(f"{subject}: {why}")
        _note(results, _run(others, "simulations", settings, progress, report))
        for piece in timed:  # alone on the machine
            piece.keep(settings.out, piece.run(lambda steps: None))
            report(f"timed {piece.variant.key}")
    with staged_folder(settings.out, study.files) as folder:
        page.write(_content(study, parts, results, folder), folder, FILES)


def _asked(cells: Sequence[Cell], settings: Settings) -> list[Cell]:
    """Those of the variants and agents asked for. ValueError for what is in no cell."""
    keys = dict.fromkeys(cell.variant.key for cell in cells)
    require_known("variant", settings.variants, keys)
    known = dict.fromkeys(agent for cell in cells for agent in cell.agents)
    for agent in settings.agents or ():
        LOCALIZERS.require(agent.split(":")[0])
        if agent not in known:
            raise ValueError(f"agent {agent!r} is not in this study: {', '.join(known)} are")
    found = []
    for cell in cells:
        agents = tuple(a for a in cell.agents if settings.agents is None or a in settings.agents)
        wanted = settings.variants is None or cell.variant.key in settings.variants
        if wanted and (agents or not cell.agents or cell.kind is None):
            found.append(Cell(cell.variant, agents, cell.runs, cell.kind, cell.key))
    return found


def _try_folder(out: Path, names: Sequence[str]) -> None:
    """Raise ValueError now if results cannot be written there later."""
    trial = RuntimeError()
    try:
        with staged_folder(out, names):
            raise trial
    except RuntimeError as error:
        if error is not trial:
            raise


def _run(
    units: Sequence[Unit],
    what: str,
    settings: Settings,
    progress: Progress,
    report: Callable[[str], None],
) -> list[tuple[Unit, str]]:
    """Run units of work; those that failed, with the reason."""
    total, done, start = sum(unit.size for unit in units), 0, time.monotonic()

    def counted(_: Unit, size: int) -> None:
        nonlocal done
        done += size
        progress(what, done, total)

    failed = []
    for i, found in enumerate(pool.work(units, settings.workers, counted), 1):
        unit, error = found.unit, found.error
        line = f"{i}/{len(units)} {unit.name}"
        if error is None:
            try:
                unit.keep(settings.out, found.result)
            except OSError as unwritten:
                error = unwritten
        if error is not None:
            why = f"{type(error).__name__}: {error}"
            failed.append((unit, why))
            line += f" failed: {why}"
        report(f"{line} ({time.monotonic() - start:.0f} s)")
    return failed


def _note(results: Results, failed: Iterable[tuple[Unit, str]]) -> None:
    for unit, why in failed:
        if isinstance(unit, Piece):
            results.failed[unit.variant.key, unit.subject] = why


# ------------------------------------------------------------------ what is written


def _content(study: Study, parts: Sequence[Part], results: Results, folder: Path) -> dict[str, Any]:
    """``results.json``; figures are written to the folder."""
    settings = results.settings
    claims = verdicts.judge((c for part in parts for c in part.claims(settings)), results)
    wanted = {
        goal.words: goal
        for part in parts
        for goal in part.goals(settings)
        if all(need[0] in results.cells for need in goal.needs)
    }
    goals = verdicts.judge_goals(wanted.values(), results)
    sections = []
    if claims:
        kinds = (verdicts.REPRODUCED, verdicts.NOT, verdicts.CONTRADICTED, verdicts.UNKNOWN)
        text = [verdicts.RULE, verdicts.counts(claims, "claims", kinds)]
        sections.append(_section("The paper's claims", text, [verdicts.claims_table(claims)]))
    if goals:
        found = verdicts.counts(goals, "goals", (verdicts.MET, verdicts.MISSED, verdicts.UNKNOWN))
        text = [verdicts.GOAL_RULE, found]
        sections.append(_section("Our goals", text, [verdicts.goals_table(goals)]))
    for part in parts:
        tables = [table for table in part.tables(results) if table.rows]
        section = _section(part.title, part.text(settings), tables)
        for name, drawing in part.figures.items():
            caption = draw(drawing, results, folder / name)
            if caption is not None:
                section["figures"].append({"file": name, "caption": caption})
        sections.append(section)
    content = {
        "study": study.name,
        "source": study.source,
        "provenance": _provenance(study, settings),
        "sections": sections,
        "claims": [verdicts.as_json(each) for each in claims],
        "goals": [verdicts.as_json(each) for each in goals],
        "figures": results.summaries(),
        "costs": _costs(results),
        "not_run": _not_run(results),
    }
    values: dict[str, Any] = plain(content)
    return values


def _section(title: str, text: Iterable[str], tables: Sequence[Table]) -> dict[str, Any]:
    written = [table.as_json() for table in tables]
    return {"title": title, "text": list(text), "tables": written, "figures": []}


def _costs(results: Results) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in results.cells:
        costs: dict[str, Cost] = results.kinds(name, COST)
        for agent, one in costs.items():
            found.setdefault(name, {})[agent] = one.summary
    return found


def _not_run(results: Results) -> list[str]:
    """What there is no result of, and why; agents that fail alike in the same places together."""
    places: dict[tuple[str, str], list[str]] = {}
    for (key, subject), why in results.failed.items():
        places.setdefault((subject, why), []).append(f"*{key}*")
    subjects: dict[tuple[str, str], list[str]] = {}
    for (subject, why), keys in places.items():
        subjects.setdefault((", ".join(keys), why), []).append(f"`{subject}`")
    return [f"{keys}, {', '.join(some)}: {why}" for (keys, why), some in subjects.items()]


def _provenance(study: Study, settings: Settings) -> dict[str, Any]:
    """Where results come from."""
    chosen = {"part": settings.part, "runs": settings.runs, "seed": settings.seed,
              "steps": settings.steps}  # fmt: skip
    usual = {"part": "all", "runs": study.runs, "seed": 0, "steps": None}
    words = [f"--{key} {value}" for key, value in chosen.items() if value != usual[key]]
    lists = {"agents": settings.agents, "variants": settings.variants}
    words += [f"--{key} {quote(','.join(some))}" for key, some in lists.items() if some is not None]
    return {
        "command": " ".join(("coloc reproduce", study.key, *words)),
        "commit": _commit(),
        "versions": {"python": platform.python_version()}
        | {name: metadata.version(name) for name in _VERSIONS},
        "machine": platform.processor() or platform.machine(),
        "date": datetime.now(UTC).date().isoformat(),
        "runs": settings.runs,
        "seed": settings.seed,
    }


def _commit() -> str | None:
    """The commit that this code lies in, if it lies in a repository."""
    asked = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    try:
        done = subprocess.run(asked, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
