"""A reference page a task, written from what is registered: what agents see, do and get."""

import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parent))
from reference import described, options, table  # which puts this checkout on the path

from agents.tasks import TASKS, make_task
from agents.tasks.task import Task
from coloc_env.options import paragraphs


def on_files(files: Files, config: Any, **_: Any) -> Files:
    files.append(File.generated(config, "reference/tasks/index.md", content=index()))
    for name in TASKS:
        path = f"reference/tasks/{name}.md"
        files.append(File.generated(config, path, content=page(name)))
    return files


def index() -> str:
    rows = [[f"[`{name}`]({name}.md)", TASKS.summary(name)] for name in TASKS]
    return "\n".join(
        [
            "# Tasks\n",
            "Worlds in which decisions matter, with an estimator in the loop. "
            "[What they are for](../../results/tasks.md); "
            "[who is best](../../results/leaderboard.md).\n",
            table(["task", "what it is"], rows),
        ]
    )


def page(name: str) -> str:
    made = make_task(name)
    return "\n".join(
        [
            f"# {name}\n",
            described(TASKS[name]),
            "## At a glance\n",
            glance(made),
            "## Observation\n",
            f"{sum(made.widths.values())} float32 numbers within −1 … 1, of estimates alone; with "
            "`obs=dict` a Dict of the parts.\n",
            table(["from", "part", "numbers", "what it is"], observation(made)),
            "## Heuristics\n",
            table(["policy", "what it does"], policies(made)),
            "## Options\n",
            options(TASKS.options_of(name), "option", 3),
        ]
    )


def observation(made: Task) -> list[list[str]]:
    """Where each part of the flat vector starts, its name, its width, and what it is."""
    rows, first = [], 0
    about = made.describe()
    for name, width in made.widths.items():
        rows.append([str(first), f"`{name}`", str(width), about[name]])
        first += width
    return rows


def policies(made: Task) -> list[list[str]]:
    found = {**made.policies, **made.planners}
    return [[f"`{name}`", paragraphs(rule.__doc__ or "")[0]] for name, rule in found.items()]


def glance(made: Task) -> str:
    arena = made.believed.arena
    sides = " × ".join(f"{b - a:g}" for a, b in zip(arena.low, arena.high, strict=True))
    action = f"`Discrete({made.choices})`" if made.choices else f"`Box({made.width})` within ±1"
    rows = [
        ["UAVs that act", f"{made.n_agents} of {arena.n_uavs}"],
        ["space", f"{sides} m"],
        ["time", f"{made.scenario.horizon} steps of {arena.dt:g} s"],
        ["action", f"{action}: {made.meaning}"],
        ["reward", "each UAV's own" if made.chosen.credit == "own" else "the team's"],
        ["estimator", f"`{made.chosen.estimator}`"],
        ["best heuristic", f"`{made.best}`"],
        ["state for critics", f"{len(made.state_bounds(made.scenario)[0])} numbers within ±1"],
    ]
    return table(["", ""], rows)
