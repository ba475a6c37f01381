"""``coloc reproduce cspf``: what is missing is flown, then the report is written."""

from collections.abc import Sequence
from pathlib import Path

from coloc_env.staging import staged_folder
from training.evaluation.evaluate import Progress
from training.reproduce.cspf import plan, real, report
from training.reproduce.pool import Note, obtain
from training.reproduce.reporting import Text, write_report
from training.reproduce.store import Store
from training.reproduce.study import Planned, Study

NAMES = (*report.FILES, "report.md")
_STORE = "store"


def reproduce(
    out: Path,
    part: str,
    runs: int,
    seed: int,
    wanted: Sequence[str] | None,
    where: Sequence[str] | None,
    steps: int | None,
    jobs: int,
    missing: bool,
    tell: Progress,
    note: Note,
) -> None:
    """Fly what the store in ``out`` lacks, then write the report of ``part`` there.

    ``wanted``: these agents only; ``where``: these variants only; None: all. ``steps``: at most so
    many of each run. ``missing=False`` flies nothing.
    """
    own, beyond, recorded = (part in (each, "all") for each in ("paper", "robustness", "real"))
    study = Study(Store(out / _STORE), seed)
    planned = _plan(own, beyond, recorded, runs, steps)
    pieces = study.chosen(planned, where, wanted)
    obtain(study, pieces, jobs, tell, note, missing)
    text: Text = []
    with staged_folder(out, NAMES) as folder:
        if own:
            text += report.paper_part(study, runs, steps, folder)
        if beyond:
            text += report.beyond_part(study, runs, steps)
        if recorded:
            text += report.real_part(study, runs, steps)
        write_report(folder, "CSPF", plan.TITLE, text, study)


def _plan(own: bool, beyond: bool, recorded: bool, runs: int, steps: int | None) -> list[Planned]:
    planned: list[Planned] = []
    if own:
        for dim in plan.DIMS:
            beside = (*plan.BESIDE, *plan.LITERAL)
            planned.append((plan.published(dim, steps), beside, runs))
        planned += [(variant, agents, runs) for variant, agents in plan.shares(steps)]
    if beyond:
        planned.append((*plan.clouds(steps), plan.few(runs)))
        for variant, agents in (*plan.teams(steps), *plan.hard(steps)):
            planned.append((variant, agents, plan.runs_in(variant, runs)))
    if recorded:
        planned += [(v, agents, plan.few(runs)) for v, agents in real.planned(steps)]
    return planned
