"""``coloc reproduce marl``: what is missing is trained and flown, then the report is written."""

import multiprocessing
from collections.abc import Sequence
from pathlib import Path

from coloc_env.options import require_known
from coloc_env.staging import staged_folder
from training.evaluation.evaluate import Progress
from training.learning import run as training_runs
from training.reproduce.marl import report
from training.reproduce.marl.plan import FILTERS, SEEDS, Trained, trainings, variants
from training.reproduce.pool import Note, obtain
from training.reproduce.store import Store
from training.reproduce.study import WORLD, Piece, Study

_STORE, _RUNS = "store", "runs"
Job = tuple[Trained, int, Path]


def reproduce(
    out: Path,
    runs: int,
    seed: int,
    wanted: Sequence[str] | None,
    jobs: int,
    missing: bool,
    tell: Progress,
    note: Note,
) -> None:
    """Train what ``out``/runs lacks (each a run's folder, resumed where it stopped), fly every
    policy beside the filters in ``runs`` worlds, and write the report.

    ``wanted``: these trainings only. ``missing=False`` trains and flies nothing.
    """
    planned = trainings()
    require_known("training", wanted, [one.key for one in planned])
    planned = [one for one in planned if wanted is None or one.key in wanted]
    todo = [(one, k, folder_of(out, one, k)) for one in planned for k in range(SEEDS)]
    if missing:
        train([job for job in todo if not finished(job)], jobs, tell, note)
    agents = {
        one.key: [one.agent(str(job[2])) for job in todo if job[0] is one and finished(job)]
        for one in planned
    }
    study = Study(Store(out / _STORE), seed)
    pieces: list[Piece] = []
    for variant, policies in variants():
        learned = [agent for key in policies for agent in agents.get(key, [])]
        for agent in (WORLD, *FILTERS, *learned):
            pieces += study.pieces(variant, agent, runs)
    obtain(study, pieces, jobs, tell, note, missing)
    with staged_folder(out, report.FILES) as folder:
        report.write(study, planned, agents, out / _RUNS, runs, folder)


def folder_of(out: Path, one: Trained, seed: int) -> Path:
    """A run's folder."""
    return (out / _RUNS / f"{one.key}-{seed}").absolute()


def finished(job: Job) -> bool:
    """Whether a run's weights are there."""
    one, _, folder = job
    return (folder / f"{one.name}.json").exists()


def train(todo: Sequence[Job], jobs: int, tell: Progress, note: Note) -> None:
    """Train, ``jobs`` runs at a time, each in a process of its own."""
    if not todo:
        return
    tell("training", 0, len(todo))
    with multiprocessing.get_context("spawn").Pool(jobs, maxtasksperchild=1) as pool:
        for done, line in enumerate(pool.imap_unordered(_train, todo), 1):
            note(f"{done}/{len(todo)} {line}")
            tell("training", done, len(todo))


def _train(job: Job) -> str:
    import torch

    from training.learning import mappo as _mappo  # noqa: F401  (registers its trainings)

    torch.set_num_threads(1)
    one, seed, folder = job
    if (folder / "run.json").exists():
        training_runs.resume(folder, lambda what, done, total: None)
    else:
        options = {**dict(one.options), "seed": seed, "score_runs": 0}
        training_runs.start(one.name, options, folder, lambda what, done, total: None)
    return f"trained {folder.name}"
