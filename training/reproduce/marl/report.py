"""The report: learning curves, every policy beside the filters and the bound, goals met or not."""

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from training.evaluation import metrics
from training.evaluation.metrics import Difference, Floats
from training.evaluation.results import Evaluation, short, table
from training.reproduce.marl import figures
from training.reproduce.marl.plan import FILTERS, Goal, Trained, goals, variants
from training.reproduce.study import WORLD, Study
from training.reproduce.verdicts import gain

FILES = ("curves.png", "goals.csv", "results.json", "report.md")
SETTLED = 10.0  # s after which a run has begun
RULE = """\
Errors are means over UAVs, steps and runs, in m, which is what the policies' reward is made of;
RMSE after 10 s beside them. A policy's figure is the mean over its training seeds, the range over
them in brackets. *Less than*: by how many per cent of the rival's, with the 95 % interval of the
differences paired by world. A goal is met if the mean is not short of it (and, where that is
demanded, the interval excludes zero)."""
Agents = Mapping[str, Sequence[str]]


@dataclass(frozen=True)
class Figures:
    """One agent in one variant: mean error of each run (m), RMSE after 10 s (m); of a policy the
    mean over training seeds, and the range of their means."""

    per_run: Floats
    steady: float
    low: float
    high: float

    @property
    def error(self) -> float:
        return float(self.per_run.mean())


def write(
    study: Study,
    planned: Sequence[Trained],
    agents: Agents,
    folder_of_runs: Path,
    runs: int,
    folder: Path,
) -> None:
    """All of ``FILES``."""
    found: dict[str, dict[str, Figures]] = {}
    bounds: dict[str, float | None] = {}
    for variant, policies in variants():
        if not study.can(variant):
            continue
        flown = [agent for key in policies for agent in agents.get(key, ())]
        results = study.results(variant, [WORLD, *FILTERS, *flown], runs)
        bounds[variant.key] = None if results.bound is None else results.bound.rmse
        there = {name: [name] for name in (WORLD, *FILTERS)}
        there |= {key: list(agents[key]) for key in policies if agents.get(key)}
        found[variant.key] = {
            key: _figures(results, names)
            for key, names in there.items()
            if all(name in results.agents for name in names)
        }
    curves = {one.key: learning_curve(one, folder_of_runs) for one in planned}
    errors = {key: {name: o.error for name, o in there.items()} for key, there in found.items()}
    caption = figures.draw(planned, curves, errors, bounds, folder / "curves.png")
    judged = [(goal, *_judge(goal, found)) for goal in goals()]
    text = [
        "# Policies that learn, beside the filters and the bound",
        "",
        f"{runs} worlds of 20 s with motion, landmarks and seeds that nothing was trained on.",
        "",
        RULE,
        "",
        "## Goals",
        "",
        *table(
            ["policy", "variant", "less than", "goal (%)", "found (%)", "verdict"],
            [_goal_line(*each) for each in judged],
            left=3,
        ),
        "",
        "## Mean error (m); RMSE after 10 s",
        "",
        *_matrix(found, bounds, planned),
        "",
        "## Learning curves",
        "",
        f"![{caption}](curves.png)",
        "",
        f"*{caption}*",
    ]
    (folder / "report.md").write_text("\n".join(text) + "\n", encoding="utf-8")
    _csv(judged, folder / "goals.csv")
    content = {
        key: {
            "bound_rmse": bounds[key],
            "agents": {
                name: {
                    "mean_error": one.error,
                    "over_seeds": [one.low, one.high],
                    "rmse_after_10s": one.steady,
                }
                for name, one in there.items()
            },
        }
        for key, there in found.items()
    }
    (folder / "results.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def learning_curve(one: Trained, folder: Path) -> list[tuple[Floats, Floats]]:
    """For each run that is there: agent-steps, and the mean error (m) of every epoch's flights."""
    curves: list[tuple[Floats, Floats]] = []
    for file in sorted(folder.glob(f"{one.key}-[0-9]*/metrics/scalars/error.csv")):
        rows = np.loadtxt(file, delimiter=",", ndmin=2)
        batches = 8  # of 25 steps, in an epoch of 200
        whole = rows[: len(rows) // batches * batches].reshape(-1, batches, 2)
        curves.append((whole[:, -1, 0], whole[..., 1].mean(1)))
    return curves


def _figures(results: Evaluation, names: Sequence[str]) -> Figures:
    per_run, steady = [], []
    for name in names:
        error, scored = results.agents[name].error, results.worlds.scored
        per_run.append((error * scored).sum((1, 2)) / scored.sum((1, 2)))
        steady.append(metrics.rmse_after(error, scored, results.dt, SETTLED))
    means = [float(each.mean()) for each in per_run]
    return Figures(np.mean(per_run, 0), float(np.mean(steady)), min(means), max(means))


def _judge(goal: Goal, found: Mapping[str, Mapping[str, Figures]]) -> tuple[Difference | None, str]:
    there = found.get(goal.variant, {})
    if goal.policy not in there or goal.rival not in there:
        return None, "not measured"
    less = gain(there[goal.policy].per_run, there[goal.rival].per_run)
    good = less.mean >= goal.least and (not goal.strict or less.low > 0)
    return less, "met" if good else "missed"


def _goal_line(goal: Goal, less: Difference | None, verdict: str) -> list[str]:
    words = "–" if less is None else f"{less.mean:.1f} ({less.low:.1f} to {less.high:.1f})"
    wanted = f"≥ {goal.least:g}" + (", interval above 0" if goal.strict else "")
    cells = [goal.policy, goal.variant, f"`{goal.rival}`", wanted, words, verdict]
    return [cell.replace("-", "−") if i in (3, 4) else cell for i, cell in enumerate(cells)]


def _matrix(
    found: Mapping[str, Mapping[str, Figures]],
    bounds: Mapping[str, float | None],
    planned: Sequence[Trained],
) -> list[str]:
    """Variants down; filters, then policies across."""
    columns = [WORLD, *FILTERS, *(one.key for one in planned)]
    columns = [name for name in columns if any(name in there for there in found.values())]
    header = ["variant", "bound (RMSE)", *(f"`{name}`" for name in columns)]
    titles = {variant.key: variant.title for variant, _ in variants()}
    lines = []
    for key, there in found.items():
        best = min(one.error for one in there.values())
        lines.append(
            [titles[key], short(bounds[key]), *(_cell(there.get(name), best) for name in columns)]
        )
    return table(header, lines)


def _cell(one: Figures | None, best: float) -> str:
    if one is None:
        return ""
    text = f"**{short(one.error)}**" if math.isclose(one.error, best) else short(one.error)
    if one.high > one.low:
        text += f" [{short(one.low)}–{short(one.high)}]"
    return f"{text}; {short(one.steady)}"


def _csv(judged: Sequence[tuple[Goal, Difference | None, str]], file: Path) -> None:
    with file.open("w", newline="", encoding="utf-8") as opened:
        writer = csv.writer(opened, lineterminator="\n")
        writer.writerow(["policy", "variant", "rival", "goal", "less", "low", "high", "verdict"])
        for goal, less, verdict in judged:
            numbers: list[Any] = [""] * 3 if less is None else [less.mean, less.low, less.high]
            writer.writerow([goal.policy, goal.variant, goal.rival, goal.least, *numbers, verdict])
