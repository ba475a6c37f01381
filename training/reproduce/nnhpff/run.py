"""``coloc reproduce nnhpff``: what is missing is trained and flown, then the report is written."""

from collections.abc import Sequence
from pathlib import Path

import training.learning.nnhpff as _nnhpff  # noqa: F401  (registers its training)
from coloc_env.staging import staged_folder
from training.evaluation.evaluate import Progress
from training.learning import run as training_runs
from training.reproduce.cost import measured
from training.reproduce.nnhpff import plan, report
from training.reproduce.nnhpff.flown import Flown, learning_curve
from training.reproduce.pool import Note, obtain
from training.reproduce.reporting import Text, write_report
from training.reproduce.store import Store
from training.reproduce.study import Planned, Study

NAMES = (*report.FILES, "report.md")
_STORE, _RUN = "store", "run"
# Figure 4's training: the paper's 27 scenarios once an epoch.
_LEARNING = {"worlds": 1, "epochs": 10, "score_runs": 0}


def reproduce(
    out: Path,
    part: str,
    runs: int,
    seed: int,
    where: Sequence[str] | None,
    steps: int | None,
    jobs: int,
    missing: bool,
    tell: Progress,
    note: Note,
) -> None:
    """Train and fly what the store in ``out`` lacks, then write the report of ``part`` there.

    ``where``: these variants only; None: all. ``steps``: at most so many of each run.
    ``missing=False`` flies nothing.
    """
    own, beyond = part != "robustness", part != "paper"
    study = Study(Store(out / _STORE), seed)
    pieces = study.chosen(_plan(own, beyond, runs, steps), where)
    obtain(study, pieces, jobs, tell, note, missing)
    if missing and own and where is None and steps is None:
        _learn(out / _RUN, tell)
    first = plan.case(1, steps)
    timed = [a for a in (*plan.METHODS, "ekf") if (first.key, a) not in study.failed]
    cost = measured(study.store, first, seed, timed, tell) if own and study.can(first) else {}
    flown = Flown(study, cost, learning_curve(out / _RUN))
    text: Text = []
    with staged_folder(out, NAMES) as folder:
        if own:
            text += report.paper_part(flown, runs, steps, folder)
            text += report.detector_part(flown, plan.scenario_runs(runs), steps, folder)
        if beyond:
            text += report.beyond_part(flown, runs, steps, folder)
        write_report(folder, "NN-HPFF", plan.TITLE, text, study)


def _plan(own: bool, beyond: bool, runs: int, steps: int | None) -> list[Planned]:
    wanted: list[Planned] = []
    if own:
        for number in plan.CASES:
            wanted.append((plan.case(number, steps), (*plan.METHODS, *plan.BESIDE), runs))
        for variant, agent in (*plan.trained_on(steps), *plan.never_seen(steps)):
            wanted.append((variant, (agent,), plan.scenario_runs(runs)))
    if beyond:
        for variant, agents in (
            *plan.sensitivity(steps),
            *plan.kidnapping(steps),
            *plan.blocked(steps),
            *plan.recordings(steps),
        ):
            wanted.append((variant, agents, plan.runs_in(variant, runs)))
    return wanted


def _learn(folder: Path, tell: Progress) -> None:
    """The training of figure 4, gone on with where it stopped."""
    if (folder / "run.json").exists():
        training_runs.resume(folder, tell)
    else:
        training_runs.start("nnhpff", _LEARNING, folder, tell)
