"""``coloc reproduce pfnn``: what is missing is flown, then the report is written."""

from collections.abc import Sequence
from pathlib import Path

from agents.registry import make
from coloc_env.options import require_known
from coloc_env.staging import staged_folder
from training.evaluation.evaluate import Progress
from training.reproduce.cost import measured
from training.reproduce.pfnn import paper, report
from training.reproduce.pfnn.flown import Flown
from training.reproduce.pfnn.in_flight import learned
from training.reproduce.pfnn.plan import (
    ROBUST_AGENTS,
    TABLE_AGENTS,
    ablation_agents,
    chosen,
    default,
    runs_in,
    variants,
)
from training.reproduce.pfnn.robustness import cells
from training.reproduce.pool import Note, obtain
from training.reproduce.reporting import Text, write_report
from training.reproduce.store import Store
from training.reproduce.study import WORLD, Piece, Study, Variant

NAMES = (*report.FILES, "report.md")
_STORE = "store"


def reproduce(
    out: Path,
    part: str,
    runs: int,
    seed: int,
    agents: Sequence[str] | None,
    where: Sequence[str] | None,
    steps: int | None,
    jobs: int,
    missing: bool,
    tell: Progress,
    note: Note,
) -> None:
    """Fly what the store in ``out`` lacks, then write the report of ``part`` there.

    ``agents``: those wanted, of the paper's and for the study of robustness; ``where``: in which of
    its variants; None: all. ``steps``: at most so many of each run. ``missing=False`` flies
    nothing.
    """
    own, beyond = part != "robustness", part != "paper"
    methods = chosen(TABLE_AGENTS, agents) if own else []
    ranges = chosen(tuple(ablation_agents()), agents) if own else []
    robust = list(ROBUST_AGENTS if agents is None else agents) if beyond else []
    base, worlds = default(steps), variants(steps)
    if where is not None:
        require_known("variant", where, [variant.key for variant in worlds])
        worlds = [variant for variant in worlds if variant.key in where]
    every = list(dict.fromkeys((*methods, *ranges, *robust)))
    for agent in (*every, *(agents or ())):
        if agent not in every:
            known = ", ".join(dict.fromkeys((*TABLE_AGENTS, *ablation_agents())))
            raise ValueError(f"agent {agent!r} is none of the paper's: {known}")
        make(agent, base.build())  # refuses a wrong name before anything is flown

    study = Study(Store(out / _STORE), seed)
    blocks = (runs, runs // 2) if runs > 1 else (runs,)
    pieces: list[Piece] = []
    if own:
        for agent in (WORLD, *methods):
            pieces += study.pieces(base, agent, *blocks)
        for agent in ranges:
            pieces += study.pieces(base, agent, runs)
    if beyond:
        for variant in worlds:
            for agent in (WORLD, *robust):
                pieces += study.pieces(variant, agent, runs_in(variant, runs))
    obtain(study, pieces, jobs, tell, note, missing)

    flown = _flown(study, base, blocks, methods, ranges, tell) if own else None
    text: Text = []
    with staged_folder(out, NAMES) as folder:
        if flown is not None:
            text += [*report.paper_part(flown, folder), ""]
        if beyond:
            found, bounds = cells(study, worlds, robust, runs)
            text += report.robust_part(found, bounds, worlds, robust, folder)
        write_report(folder, "PF-NN", paper.TITLE, text, study)


def _flown(
    study: Study,
    variant: Variant,
    blocks: tuple[int, ...],
    agents: Sequence[str],
    ranges: Sequence[str],
    tell: Progress,
) -> Flown:
    """All that the paper's part reports from; costs and learning in flight, too."""
    tables = study.results(variant, list(dict.fromkeys((*agents, *ranges))), blocks[0])
    flown = [agent for agent in agents if agent in tables.agents]
    learning = None
    if "pfnn" in flown:
        learning = learned(study.store, variant, study.seed, blocks[0], tell)
    return Flown(
        tables=tables,
        cdf=study.results(variant, flown, *blocks),
        cost=measured(study.store, variant, study.seed, flown, tell),
        learning=learning,
    )
