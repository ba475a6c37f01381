"""Results of an evaluation: the metrics of ``results.json``."""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch

from coloc_env.bounds import Bound
from coloc_env.scenario import Scenario
from training.evaluation import metrics
from training.evaluation.innovations import disagreement
from training.evaluation.metrics import Difference, Flags, Floats
from training.evaluation.record import RunRecord, Worlds

# What results.json has of an agent, in its order.
METRICS = (
    "rmse",
    "rmse_std",
    "mean",
    "median",
    "max",
    "per_uav_rmse",
    "rmse_after_10s",
    "diverged_runs",
    "nees",
    "avg_particles",
    "bytes_per_step",
    "ms_per_step",
    "ratio_to_bound",
    "diagnostics",
)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """All agents' runs in the same worlds, and the bound of those worlds (None: none is known).

    ``errors``: of agents whose evaluation ended in an error, what it was. ``innovations``: of each
    agent what can be said without truth, where there is none (``training.evaluation.innovations``).
    """

    scenario: Scenario
    worlds: Worlds
    bound: Bound | None
    agents: dict[str, RunRecord]
    errors: dict[str, str] = field(default_factory=dict)
    innovations: dict[str, dict[str, float]] = field(default_factory=dict)

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
    def origin(self) -> Floats:
        """Where the zero of all positions is in the frame of what was recorded [d], m."""
        return np.array(self.scenario.arena.origin or (0.0,) * self.scenario.arena.dim)

    @property
    def lost_beyond(self) -> float:
        """The error in m beyond which a UAV counts as lost: a tenth of the arena's longest side."""
        arena = self.scenario.arena
        sides = [b - a for a, b in zip(arena.low, arena.high, strict=True)]
        return metrics.LOST_SHARE * max(sides)

    @cached_property
    def dropped(self) -> dict[str, int]:
        """By stream of a recording, how many measurements were left out as none that a sensor can
        have made."""
        found = [getattr(sensor, "dropped", {}) for sensor in self.scenario.sensors]
        return {stream: count for one in found for stream, count in one.items() if count}

    @cached_property
    def reference(self) -> Floats | None:
        """The scenario's reference less the truth [R, K, N, d], m; None without one."""
        if self.scenario.reference is None:
            return None
        seeds = torch.arange(self.seed, self.seed + self.runs)
        _, steps, n_uavs, dim = self.worlds.truth.shape
        return self.scenario.reference.errors(seeds, steps, n_uavs, dim, self.dt)

    @cached_property
    def disagreement(self) -> dict[str, float]:
        """How far each agent is from the mean of the others, m; known where truth is not."""
        if not self.innovations:
            return {}
        return disagreement({name: one.offset for name, one in self.agents.items()})

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
            "agents": {name: self._metrics(name) for name in self.agents}
            | {name: self._no_metrics(error) for name, error in self.errors.items()},
        }

    def _repr_html_(self) -> str:
        """The main table, in notebooks."""
        from training.evaluation.tables import html_table

        return html_table(self)

    def _metrics(self, agent: str) -> dict[str, Any]:
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
            "bytes_per_step": own.pop("bytes", None),
            "ms_per_step": one.ms_per_step,
            "ratio_to_bound": rmse / bound if bound > 0 else None,
            "diagnostics": self._diagnostics(agent) | own,
        }
        return {key: plain(figures[key]) for key in METRICS}

    def _no_metrics(self, error: str) -> dict[str, Any]:
        """What stands for an agent whose evaluation ended in an error."""
        unknown = [None] * self.scenario.arena.n_uavs
        return dict.fromkeys(METRICS) | {"per_uav_rmse": unknown, "diagnostics": {"error": error}}

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
        figures |= self.innovations.get(agent, {})
        if agent in self.disagreement:
            figures["disagreement"] = self.disagreement[agent]
        if self.dropped:
            figures["dropped_measurements"] = sum(self.dropped.values())
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
