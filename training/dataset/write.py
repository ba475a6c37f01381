"""Writing a dataset part by part, each whole or not at all, and going on where it was left."""

import json
import shutil
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from agents.localizer import Localizer
from agents.registry import make
from coloc_env.commands import Commands
from coloc_env.json_files import read_json
from coloc_env.rewards import reward
from coloc_env.staging import locked, remove_leftovers, staged_file, staged_folder
from training.dataset.card import card
from training.dataset.commands import random_commands
from training.dataset.parquet import require_pyarrow, write_steps, write_worlds
from training.dataset.plan import Plan
from training.evaluation.rollout import Breakdown, Step, rollout

CARD, FACTS = "README.md", "dataset.json"
_NEEDED = {
    "scenario": str,
    "overrides": dict[str, str],
    "seed": int,
    "runs": int,
    "steps": int,
    "agent": str | None,
}
Progress = Callable[[str, int, int], None]


def write_dataset(
    plan: Plan, out: Path, progress: Progress = lambda what, done, total: None
) -> None:
    """Write all parts of a dataset that are not there yet, and its card.

    ``out`` receives ``steps/part-….parquet`` (a row for each run, step and UAV),
    ``worlds/part-….parquet`` (a row for each run and UAV), the same as memory-mapped TensorDicts in
    ``tensordict/part-…``, ``dataset.json`` and ``README.md``. A part is there once its
    ``steps`` file is; a process that was killed leaves no half of one.

    Raises ValueError where ``out`` holds something else, another dataset, or is being written.
    """
    require_pyarrow()
    localizer = None if plan.agent is None else make(plan.agent, plan.scenario)
    out.mkdir(parents=True, exist_ok=True)
    with locked(out, f"{out} is being written by another process"):
        _require_own(plan, out)
        for folder in ("steps", "worlds", "tensordict"):
            (out / folder).mkdir(exist_ok=True)
        remove_leftovers(out)
        _describe(plan, out, whole=False)
        for i, (name, seeds) in enumerate(plan.parts()):
            progress("parts", i, plan.count)
            if not (out / "steps" / f"{name}.parquet").exists():
                _write_part(plan, localizer, seeds, out, name)
        progress("parts", plan.count, plan.count)
        _describe(plan, out, whole=True)


def _require_own(plan: Plan, out: Path) -> None:
    """Refuse a folder that holds anything but the beginning of just this dataset."""
    path = out / FACTS
    if not path.exists():
        if others := sorted(each.name for each in out.iterdir() if each.name[0] != "."):
            raise ValueError(f"{out} holds {others[0]!r} but no {FACTS}: give another folder")
        return
    found = read_json(path, "a dataset's description", _NEEDED)
    for name, wanted in plan.facts().items():
        if found[name] != wanted:
            raise ValueError(
                f"{out} holds a dataset of {name}={found[name]!r}, not {wanted!r}: "
                "give another folder"
            )


def _describe(plan: Plan, out: Path, whole: bool) -> None:
    """The card, and the facts, which come last."""
    columns = [
        {
            "name": column.title,
            "of": "run and UAV" if column.world else "run, step and UAV",
            "numbers": column.leaf.width,
            "dtype": str(column.dtype).removeprefix("torch."),
            "unit": column.leaf.unit,
            "frame": column.leaf.frame,
        }
        for column in plan.columns
    ]
    arena = plan.scenario.arena
    facts: dict[str, Any] = plan.facts() | {
        "complete": whole,
        "parts": plan.count,
        "runs_in_part": plan.runs_in_part,
        "uavs": arena.n_uavs,
        "dt": arena.dt,
        "version": version("coloc-env"),
        "command": plan.command("DIR"),
        "columns": columns,
    }
    with staged_file(out / CARD) as file:
        file.write_text(card(plan, whole), encoding="utf-8")
    with staged_file(out / FACTS) as file:
        file.write_text(json.dumps(facts, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _write_part(
    plan: Plan, localizer: Localizer | None, seeds: Tensor, out: Path, name: str
) -> None:
    home = out / "tensordict" / name
    shutil.rmtree(home, ignore_errors=True)  # of a part that was left before its tables were there
    with staged_folder(home, ("meta.json",)) as folder:
        _run(plan, localizer, seeds, folder)
    found = TensorDict.load_memmap(home)
    with staged_file(out / "worlds" / f"{name}.parquet") as file:
        write_worlds(plan, found, file)
    with staged_file(out / "steps" / f"{name}.parquet") as file:
        write_steps(plan, found, file)


def _run(plan: Plan, localizer: Localizer | None, seeds: Tensor, folder: Path) -> None:
    """The runs of some seeds, straight into memory-mapped tensors: ``seed`` [R], ``steps``
    [R, K, N] and ``worlds`` [R, N]."""
    of_worlds = len(seeds), plan.scenario.arena.n_uavs
    of_steps = len(seeds), plan.steps, plan.scenario.arena.n_uavs
    blank = TensorDict({"seed": seeds}, batch_size=of_worlds[:1])
    for group, shape in (("steps", of_steps), ("worlds", of_worlds)):
        blank[group] = TensorDict({}, batch_size=shape)
        for column in plan.columns:
            if column.world == (group == "worlds"):
                width = () if column.dtype == torch.bool else (column.leaf.width,)
                nothing = torch.zeros((), dtype=column.dtype).expand(*shape, *width)
                blank[group].set(column.name, nothing)
    whole = blank.memmap_like(folder)
    whole["seed"].copy_(seeds)
    steps, worlds = whole["steps"], whole["worlds"]
    for step in _rollout(plan, localizer, seeds):
        for keys, value in _of_step(plan, step, seeds).items():
            steps.get(keys)[:, step.k].copy_(value)
        if step.k == 0:
            for key, value in step.world.static.items():
                worlds.get(key).copy_(value)


def _rollout(plan: Plan, localizer: Localizer | None, seeds: Tensor) -> Iterator[Step]:
    """Steps; ValueError where the agent breaks down."""

    def following(k: int) -> Commands:
        return Commands(motion=random_commands(plan.scenario, seeds, k))

    commands = following if plan.scenario.motion.steered else None
    try:
        yield from rollout(localizer, plan.scenario, seeds, plan.steps, commands=commands)
    except Breakdown as breakdown:
        which = f"seeds {int(seeds[0])} to {int(seeds[-1])}"
        raise ValueError(f"{plan.agent}: {breakdown} (in the runs of {which})") from breakdown


def _of_step(plan: Plan, step: Step, seeds: Tensor) -> dict[tuple[str, ...], Tensor]:
    """All columns of a step, [R, N, …] each."""
    world, truth = step.world, step.world.truth
    found = {
        ("truth", "position"): truth.position,
        ("truth", "velocity"): truth.velocity,
        ("truth", "attitude"): truth.attitude,
        ("alive",): world.alive,
        ("scored",): world.now.scored,
    }
    if plan.scenario.motion.steered:
        found["command",] = random_commands(plan.scenario, seeds, step.k)
    if plan.agent is not None:
        error, scored = world.score(step.action)
        kind, target = plan.scenario.reward, world.now.target
        found["reward",] = reward(kind, step.action, target, error, scored).unsqueeze(-1)
        found["action",] = step.action
    for column in plan.columns:
        if column.name[0] == "observation":
            found[column.name] = step.observation[column.name[1]]
    return found
