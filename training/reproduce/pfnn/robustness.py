"""The study of robustness in numbers: every agent in every variant, paired."""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from training.evaluation import metrics
from training.evaluation.metrics import Difference, Floats
from training.evaluation.results import Evaluation, short, table
from training.reproduce.pfnn.plan import runs_in
from training.reproduce.study import Study, Variant

REFERENCES = ("apf", "ekf:robust=huber")  # paired differences are taken to these
MATRICES = {
    "rmse": "RMSE over the whole run (m)",
    "rmse_after_10s": "RMSE after 10 s (m)",
    "median": "Median error (m)",
    "nees": "NEES (ideal: 3; 2 in the plane)",
    "lost_uavs": "Lost UAVs, of all UAVs of all runs",
}
Row = dict[str, Any]


class Cell:
    """One agent in one variant: figures, and what of each run they are made of."""

    def __init__(self, results: Evaluation, agent: str) -> None:
        one, scored = results.agents[agent], results.worlds.scored
        self.rmse: Floats = metrics.rmse_per_run(one.error, scored)
        lost = metrics.lost(one.error, scored, results.dt, results.lost_beyond)
        self.figures: dict[str, Any] = {
            key: value
            for key, value in results.summary["agents"][agent].items()
            if key not in ("per_uav_rmse", "diagnostics", "ms_per_step")
        }
        self.figures |= {"lost_uavs": int(lost.sum()), "raised_runs": len(one.messages)}
        self.raised = one.messages[0] if one.messages else None


Cells = dict[str, dict[str, Cell]]  # by variant's key, then agent


def cells(
    study: Study, variants: Sequence[Variant], agents: Sequence[str], runs: int
) -> tuple[Cells, dict[str, float | None]]:
    """All that was flown, and each variant's bound (m)."""
    found: Cells = {}
    bounds: dict[str, float | None] = {}
    for variant in variants:
        if study.can(variant):
            results = study.results(variant, agents, runs_in(variant, runs))
            found[variant.key] = {agent: Cell(results, agent) for agent in results.agents}
            bounds[variant.key] = None if results.bound is None else results.bound.rmse
    return found, bounds


def compare(
    there: Mapping[str, Cell],
    agent: str,
    other: str,
    of: Callable[[Floats], Floats] = np.asarray,
) -> Difference | None:
    """RMSE of ``agent`` minus that of ``other`` in the same worlds, m; or of a function of them."""
    if agent not in there or other not in there or agent == other:
        return None
    return metrics.paired_difference(of(there[agent].rmse), of(there[other].rmse))


def rows(
    found: Cells, bounds: Mapping[str, float | None], variants: Sequence[Variant]
) -> list[Row]:
    """One per variant and agent: numbers, and None where a figure does not apply."""
    lines = []
    for variant in variants:
        there = found.get(variant.key, {})
        for agent, cell in there.items():
            row: Row = {"variant": variant.key, "title": variant.title, "agent": agent}
            row |= {"runs": len(cell.rmse), "bound": bounds[variant.key], **cell.figures}
            for other in REFERENCES:
                apart = compare(there, agent, other)
                row[f"minus {other}"] = None if apart is None else apart.mean
                row[f"minus {other}, low"] = None if apart is None else _finite(apart.low)
                row[f"minus {other}, high"] = None if apart is None else _finite(apart.high)
            lines.append(row)
    return lines


def matrix(
    found: Cells,
    bounds: Mapping[str, float | None],
    variants: Sequence[Variant],
    agents: Sequence[str],
    key: str,
) -> list[str]:
    """A Markdown table of one figure: variants down, agents across; the best of a line is bold."""
    with_bound = key == "rmse"
    header = ["variant", *(["bound"] if with_bound else []), *(f"`{a}`" for a in agents)]
    lines = []
    for variant in variants:
        there = found.get(variant.key, {})
        values = {a: there[a].figures[key] for a in agents if a in there}
        known = [v for v in values.values() if v is not None]
        best = min(known) if known and key in ("rmse", "rmse_after_10s", "median") else None
        cells = [_cell(values.get(agent), best) for agent in agents]
        lines.append(
            [variant.title, *([short(bounds.get(variant.key))] if with_bound else []), *cells]
        )
    return table(header, lines)


def csv_text(lines: Sequence[Row]) -> str:
    """The rows as CSV; empty where a figure does not apply."""
    out = io.StringIO()
    columns = list(dict.fromkeys(key for line in lines for key in line))
    writer = csv.DictWriter(out, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return out.getvalue()


def full_table(lines: Sequence[Row]) -> list[str]:
    """Everything in one Markdown table."""
    header = ["variant", "agent", "RMSE (m)", "± runs", "after 10 s", "median", "max", "NEES"]
    header += [
        "lost UAVs",
        "diverged runs",
        "× bound",
        *(f"minus `{x}` (95 %)" for x in REFERENCES),
    ]
    body = []
    for line in lines:
        figures = ("rmse", "rmse_std", "rmse_after_10s", "median", "max", "nees", "lost_uavs")
        cells = [short(line[key]) for key in (*figures, "diverged_runs", "ratio_to_bound")]
        if line["raised_runs"]:
            cells[-2] += f" ({line['raised_runs']} raised)"
        body.append([line["title"], f"`{line['agent']}`", *cells, *map(_apart(line), REFERENCES)])
    return table(header, body, left=2)


def _apart(line: Row) -> Any:
    def words(other: str) -> str:
        values = [line[f"minus {other}{end}"] for end in ("", ", low", ", high")]
        if values[0] is None:
            return "–"
        mean, low, high = (
            "∞" if value is None else f"{value:+.2g}".replace("-", "−") for value in values
        )
        return f"{mean} ({low} to {high})"

    return words


def _cell(value: float | None, best: float | None) -> str:
    text = short(value)
    return f"**{text}**" if value is not None and value == best else text


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
