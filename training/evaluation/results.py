"""Results of an evaluation: the figures of ``results.json``, tables, and a folder of files."""

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from coloc_env.bounds import Bound
from coloc_env.scenario import Scenario
from training.evaluation import metrics
from training.evaluation.metrics import Difference, Flags, Floats
from training.evaluation.record import RunRecord, Worlds

FIGURES = ("error_over_time.png", "cdf.png", "boxes.png", "nees.png", "trajectories.png")
NAMES = ("results.csv", "table.md", *FIGURES, "tum", "results.json")
COLUMNS = {
    "rmse": "RMSE",
    "rmse_std": "± runs",
    "mean": "mean",
    "median": "median",
    "max": "max",
    "rmse_after_10s": "after 10 s",
    "diverged_runs": "diverged",
    "nees": "NEES",
    "avg_particles": "particles",
    "ms_per_step": "ms/step",
    "ratio_to_bound": "× bound",
}

_EXPLAINED = """\
Position errors in m, all agents on the same worlds; RMSE over UAVs, steps and runs, ± its
standard deviation over runs; max is the mean over runs and UAVs of the largest error. A run counts
as diverged if a UAV's error stays above {:g} m over its last {:g} s, or if an estimate was not
finite; it stays in every figure. NEES: {} is consistent, more is overconfident. ms/step: the whole
team, one world, one thread."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """All agents' runs in the same worlds, and the bound of those worlds (None: none is known)."""

    scenario: Scenario
    worlds: Worlds
    bound: Bound | None
    agents: dict[str, RunRecord]

    @property
    def seed(self) -> int:
        """Seed of the first world."""
        return self.worlds.seed

    @property
    def runs(self) -> int:
        return len(self.worlds.truth)

    @property
    def dt(self) -> float:
        """Seconds a step."""
        return self.scenario.arena.dt

    @property
    def lost_beyond(self) -> float:
        """The error in m beyond which a UAV counts as lost: a tenth of the arena's longest side."""
        arena = self.scenario.arena
        sides = [b - a for a, b in zip(arena.low, arena.high, strict=True)]
        return metrics.LOST_SHARE * max(sides)

    @cached_property
    def reference(self) -> Floats | None:
        """What the scenario's reference says less the truth [R, K, N, d], m; None without one."""
        if self.scenario.reference is None:
            return None
        seeds = torch.arange(self.seed, self.seed + self.runs)
        _, steps, n_uavs, dim = self.worlds.truth.shape
        return self.scenario.reference.errors(seeds, steps, n_uavs, dim, self.dt)

    def diverged(self, agent: str) -> Flags:
        """[R]: runs in which a UAV ends lost or an estimate was not finite."""
        one = self.agents[agent]
        lost = metrics.lost(one.error, self.worlds.scored, self.dt, self.lost_beyond)
        return one.broken | lost.any(1)

    def paired_difference(self, a: str, b: str) -> Difference:
        """RMSE of agent ``a`` minus that of ``b``, run by run: mean and 95 % interval, m."""
        first, second = (
            metrics.rmse_per_run(self.agents[x].error, self.worlds.scored) for x in (a, b)
        )
        return metrics.paired_difference(first, second)

    @cached_property
    def summary(self) -> dict[str, Any]:
        """The content of ``results.json``: numbers, and None where a figure does not apply."""
        scenario = self.scenario
        return {
            "scenario": scenario.name,
            "overrides": {k: plain(v) for k, v in scenario.overrides.items()},
            "seed": self.seed,
            "runs": self.runs,
            "steps": scenario.horizon,
            "bound": {"rmse": None if self.bound is None else _number(self.bound.rmse)},
            "agents": {name: self._figures(name) for name in self.agents},
        }

    def _figures(self, agent: str) -> dict[str, Any]:
        one, scored = self.agents[agent], self.worlds.scored
        errors, per_run = one.error[scored], metrics.rmse_per_run(one.error, scored)
        per_run = per_run[np.isfinite(per_run)]
        rmse = metrics.rmse(one.error, scored)
        bound = float("nan") if self.bound is None else self.bound.rmse
        own = {
            name: metrics.per_run(values, scored)
            if name.endswith("_per_run")
            else metrics.mean(values[scored])
            for name, values in one.series.items()
        }
        figures: dict[str, Any] = {
            "rmse": rmse,
            "rmse_std": per_run.std(ddof=1) if len(per_run) > 1 else None,
            "mean": metrics.mean(errors),
            "median": np.median(errors) if errors.size else None,
            "max": metrics.largest(one.error, scored),
            "per_uav_rmse": metrics.rmse_per_uav(one.error, scored).tolist(),
            "rmse_after_10s": metrics.rmse_after(one.error, scored, self.dt, 10.0),
            "diverged_runs": int(self.diverged(agent).sum()),
            "nees": metrics.mean(one.nees[scored]),
            "avg_particles": own.pop("particles", None),
            "ms_per_step": one.ms_per_step,
            "ratio_to_bound": rmse / bound if bound > 0 else None,
            "diagnostics": self._diagnostics(agent) | own,
        }
        return {key: plain(value) for key, value in figures.items()}

    def _diagnostics(self, agent: str) -> dict[str, float]:
        one, scored, dim = self.agents[agent], self.worlds.scored, self.scenario.arena.dim
        errors = one.error[scored]
        low, high = metrics.nees_band(dim, max(1, int(scored.any(1).sum())))
        figures = {
            "p90": float(np.percentile(errors, 90)) if errors.size else float("nan"),
            "ate": metrics.ate(one.error, scored),
            "rpe_1s": metrics.rpe(one.offset, scored, max(1, round(1 / self.dt))),
            "nees_low": low,
            "nees_high": high,
        }
        if self.scenario.arena.n_uavs > 1:
            figures["relative_error"] = metrics.relative_error(one.offset, scored)
            figures["fge"] = metrics.formation_error(self.worlds.truth, one.offset, scored)
        if self.scenario.network.radius is not None:
            figures["nrmse"] = metrics.rmse(one.error, scored) / self.scenario.network.radius
        if self.reference is not None:
            apart = one.offset - self.reference
            error = np.linalg.norm(apart, axis=-1)
            figures["ate_reference"] = metrics.ate(error, scored)
            if self.scenario.arena.n_uavs > 1:
                standing = self.worlds.truth + self.reference
                figures["fge_reference"] = metrics.formation_error(standing, apart, scored)
        undefined = float(np.isnan(one.nees[scored]).mean()) if errors.size else 0.0
        if undefined:
            figures["nees_undefined_share"] = undefined
        if one.messages:
            figures["raised_runs"] = len(one.messages)
        return figures


def _number(value: float) -> float | int | None:
    """A plain number; None for NaN and infinity."""
    value = value.item() if isinstance(value, np.generic) else value
    return value if math.isfinite(value) else None


def plain(value: Any) -> Any:
    """A value as JSON knows it."""
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return value if value is None or isinstance(value, str | bool) else _number(value)


# ------------------------------------------------------------------ tables and files


def rows(results: Evaluation, keys: Iterable[str] = COLUMNS) -> list[list[str]]:
    """The main table as text: one line for the bound, if known, and one per agent."""
    keys = tuple(keys)
    bound, lines = results.bound, []
    if bound is not None:
        known = {"rmse": bound.rmse, "rmse_after_10s": bound.rmse_after(10.0)}
        lines.append(["bound", *(short(plain(known.get(key))) for key in keys)])
    for name, figures in results.summary["agents"].items():
        lines.append([name, *(short(figures[key]) for key in keys)])
    return lines


def markdown(results: Evaluation) -> str:
    """The main table, paired differences to the first agent, and what the words mean."""
    names, dim = list(results.agents), results.scenario.arena.dim
    what = f"{results.runs} runs of {results.scenario.horizon} steps of {results.dt:g} s"
    last = results.seed + results.runs - 1
    text = [f"# {results.scenario.name}: {what}, seeds {results.seed} to {last}", ""]
    if results.scenario.overrides:
        chosen = (f"`{key}={typed(value)}`" for key, value in results.scenario.overrides.items())
        text += ["Overrides: " + ", ".join(chosen) + ".", ""]
    text += table(["agent", *COLUMNS.values()], rows(results))
    text += ["", _EXPLAINED.format(results.lost_beyond, metrics.LOST_SECONDS, dim)]
    if len(names) > 1 and results.runs > 1:
        differences = [[name, *_interval(results, name, names[0])] for name in names[1:]]
        text += ["", f"RMSE minus that of `{names[0]}`, paired by run:", ""]
        text += table(["agent", "mean difference", "95 % interval"], differences)
    for name, one in results.agents.items():
        if one.messages:
            how_many = f"{len(one.messages)} of {results.runs} runs"
            text += ["", f"`{name}` raised in {how_many}; the first at {one.messages[0]}"]
    return "\n".join(text) + "\n"


def typed(value: Any) -> str:
    """A setting as it would be typed on a command line."""
    if isinstance(value, list | tuple):
        return ",".join(map(typed, value))
    return str(value).lower() if value is None or isinstance(value, bool) else str(value)


def csv_text(results: Evaluation) -> str:
    """One line per agent; empty where a figure does not apply."""
    lines = []
    for name, figures in results.summary["agents"].items():
        per_uav = {f"rmse_uav_{i}": x for i, x in enumerate(figures["per_uav_rmse"])}
        line = {k: v for k, v in figures.items() if k not in ("per_uav_rmse", "diagnostics")}
        lines.append({"agent": name} | line | figures["diagnostics"] | per_uav)
    out = io.StringIO()
    columns = list(dict.fromkeys(key for line in lines for key in line))
    writer = csv.DictWriter(out, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return out.getvalue()


def write(results: Evaluation, folder: Path, figures: bool = True) -> None:
    """Write everything into an empty folder (a staged one: ``coloc_env.staging``)."""
    from training.evaluation.tum import write_tum

    (folder / "results.csv").write_text(csv_text(results), encoding="utf-8")
    (folder / "table.md").write_text(markdown(results), encoding="utf-8")
    write_tum(results, folder / "tum")
    if figures:
        from training.evaluation.figures import draw

        draw(results, folder)
    text = json.dumps(results.summary, indent=2, allow_nan=False, ensure_ascii=False)
    (folder / "results.json").write_text(text + "\n", encoding="utf-8")


def _interval(results: Evaluation, a: str, b: str) -> list[str]:
    difference = results.paired_difference(a, b)
    return [signed(difference.mean), f"{signed(difference.low)} to {signed(difference.high)}"]


def table(header: Sequence[str], lines: Iterable[Sequence[str]], left: int = 1) -> list[str]:
    """The lines of a Markdown table; all columns but the first ``left`` are set right."""
    every = [header, [*["---"] * left, *["---:"] * (len(header) - left)], *lines]
    return ["| " + " | ".join(cells) + " |" for cells in every]


def signed(value: float) -> str:
    """Two digits and a sign."""
    return f"{value:+.2g}".replace("-", "−")


def short(value: float | None) -> str:
    """Three digits, no exponent where it can be helped."""
    if value is None:
        return "–"
    if isinstance(value, int) or 100 <= abs(value) < 1e6:
        return f"{value:.0f}"
    return f"{value:.3g}"
