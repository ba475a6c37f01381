"""Runs of trainings on tasks as a table, a picture of their curves, and JSON.

``python -m training.learning.tasks.report runs/* --out docs/results``: runs that differ in their
seed alone are one line. Returns are those of the cards: final weights in the protocol's worlds.
"""

import argparse
import json
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from agents.tasks import TASKS, leaderboard, make_task
from coloc_env.options import typed
from training.evaluation.score import FIRST_SEED, WORLDS
from training.learning import curves
from training.learning.registry import TRAININGS

NAME = "learned_tasks"


@dataclass(frozen=True)
class Recipe:
    """Runs of one training with the same options, but for the seed; ``returns`` of final weights,
    ``learned``: their curves of the training's own returns."""

    training: str
    options: Mapping[str, Any]
    returns: tuple[float, ...]
    learned: tuple[curves.Curve, ...]
    agents: int

    @property
    def task(self) -> str:
        return str(self.options["task"]).split(":")[0]

    @property
    def chosen(self) -> str:
        """The options that are not as they are by default."""
        defaults = {key: one.default for key, one in TRAININGS.options_of(self.training).items()}
        other = {k: v for k, v in self.options.items() if v != defaults[k] and k != "task"}
        extra = str(self.options["task"]).split(":")[1:]
        return " ".join([*extra, *(f"{key}={typed(value)}" for key, value in other.items())])

    @property
    def steps(self) -> float:
        """Millions of agent-steps."""
        frames = self.learned[0][-1][0] * self.options.get("hold", 1)
        return frames * self.agents / 1e6 if self.training != "task-sb3-ppo" else frames / 1e6


def recipes(folders: Sequence[Path]) -> list[Recipe]:
    """The finished runs of some folders, by task and mean return, the best first."""
    groups: dict[str, list[tuple[dict[str, Any], curves.Curve]]] = {}
    for folder in folders:
        config = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        file = folder / f"{config['training']}.json"
        if not file.exists():
            continue
        card = json.loads(file.read_text(encoding="utf-8"))
        if card["scores"].get("worlds") != WORLDS:
            continue
        options = {key: value for key, value in card["options"].items() if key != "seed"}
        key = json.dumps([card["training"], options], sort_keys=True)
        groups.setdefault(key, []).append((card, curves.read(folder)["return"]))
    found = []
    for key, runs in groups.items():
        training, options = json.loads(key)
        returns = tuple(card["scores"]["return"] for card, _ in runs)
        n = make_task(options["task"]).n_agents
        found.append(Recipe(training, options, returns, tuple(curve for _, curve in runs), n))
    return sorted(found, key=lambda one: (one.task, -float(np.mean(one.returns))))


def table(found: Sequence[Recipe]) -> dict[str, Any]:
    """The table of some recipes, as pages of results take it."""
    rows = []
    for one in found:
        returns = np.array(one.returns)
        spread = f" ± {returns.std(ddof=1):.2f}" if len(returns) > 1 else ""
        rows.append(
            [
                f"`{one.task}`",
                f"`{one.training}`",
                f"`{one.chosen}`" if one.chosen else "",
                str(len(returns)),
                f"{one.steps:.1f}",
                f"{returns.mean():.2f}{spread}".replace("-", "−"),
                " ".join(f"{x:.1f}" for x in returns).replace("-", "−"),
            ]
        )
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    return {
        "title": "Policies that learn on tasks",
        "caption": f"Return of final weights in the protocol's {WORLDS} worlds (seeds from "
        f"{FIRST_SEED} on): mean ± standard deviation over training seeds, and each; millions of "
        "agent-steps of a training. Options that are not the training's default.",
        "command": "coloc train TRAINING --set task=TASK …",
        "provenance": f"measured at commit {commit}, {date.today().isoformat()}",
        "header": ["task", "training", "options", "seeds", "M steps", "return", "each"],
        "align": ["left", "left", "left", "right", "right", "right", "left"],
        "rows": rows,
    }


def picture(found: Sequence[Recipe], known: Mapping[str, tuple[str, float]]) -> Figure:
    """Returns while training: the best recipe of each task, its seeds' mean and range, beside the
    best heuristic of the protocol, dashed."""
    best = {one.task: one for one in reversed(found)}
    figure = Figure(figsize=(3.2 * len(best), 3.0), layout="constrained")
    every = figure.subplots(1, len(best), squeeze=False)[0]
    for axes, (task, one) in zip(every, sorted(best.items()), strict=True):
        values = np.array([[value for _, value in curve] for curve in one.learned])
        steps = np.linspace(0, one.steps, values.shape[1] + 1)[1:]
        axes.fill_between(steps, values.min(0), values.max(0), alpha=0.25, linewidth=0)
        axes.plot(steps, values.mean(0))
        if task in known:
            name, value = known[task]
            axes.axhline(value, linestyle="--", color="black", linewidth=1)
            axes.annotate(name, (steps[-1], value), ha="right", va="bottom", fontsize=8)
        axes.set_title(f"{task}, {len(values)} seeds", loc="left", fontsize=10)
        axes.set_xlabel("million agent-steps")
        axes.spines[["top", "right"]].set_visible(False)
    every[0].set_ylabel("return")
    return figure


def heuristics() -> dict[str, tuple[str, float]]:
    """The best heuristic of each task and its return, from the stored scores of the protocol."""
    found: dict[str, tuple[str, float]] = {}
    for name in TASKS:
        factory: Any = TASKS[name]
        file = leaderboard.FOLDER / name / f"{factory.best}.json"
        if file.exists():
            score = json.loads(file.read_text(encoding="utf-8"))
            found[name] = (factory.best, score["return"])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="folders of runs")
    parser.add_argument("--out", type=Path, default=Path("docs/results"), help="of the pages")
    chosen = parser.parse_args()
    found = recipes(chosen.runs)
    if not found:
        raise SystemExit(f"no finished run was scored in {WORLDS} worlds")
    measured = chosen.out / "measured"
    measured.mkdir(parents=True, exist_ok=True)
    text = json.dumps(table(found), indent=2, ensure_ascii=False) + "\n"
    (measured / f"{NAME}.json").write_text(text, encoding="utf-8")
    each = [
        {"task": one.options["task"], "training": one.training, "options": dict(one.options)}
        | {"returns": one.returns, "curves": one.learned}
        for one in found
    ]
    (chosen.out.parent / "assets").mkdir(exist_ok=True)
    (chosen.out.parent / "assets" / f"{NAME}.json").write_text(json.dumps(each) + "\n")
    picture(found, heuristics()).savefig(chosen.out.parent / "assets" / f"{NAME}.png", dpi=110)


if __name__ == "__main__":
    main()
