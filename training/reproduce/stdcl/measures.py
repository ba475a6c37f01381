"""Figures of the paper, per run, from errors [R, K, N], and of a bound's likeness to them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from coloc_env.bounds import Bound, SnapshotBound
from training.evaluation import metrics
from training.evaluation.metrics import Difference, Floats
from training.reproduce.runs import AgentRuns
from training.reproduce.verdicts import gain

START, END = slice(10, 110), slice(-100, None)  # steps of a long run that are compared


@dataclass(frozen=True, eq=False)
class Runs(AgentRuns):
    """An agent's runs in a variant."""

    @property
    def radius(self) -> float:
        """The network's reach R in m: what the paper divides errors by; NaN without one."""
        reach = self.results.scenario.network.radius
        return float("nan") if reach is None else reach

    @cached_property
    def rmse(self) -> Floats:
        """[R], m."""
        return metrics.rmse_per_run(self.error, self.scored)

    @property
    def whole(self) -> float:
        """RMSE over all runs, m."""
        return metrics.rmse(self.error, self.scored)

    @property
    def nrmse(self) -> Floats:
        """[R]: equation 41."""
        return self.rmse / self.radius

    @cached_property
    def per_step(self) -> Floats:
        """[K]: RMSE over runs and UAVs, m."""
        return metrics.rmse_per_step(self.error, self.scored)

    def quantile(self, share: float) -> float:
        """Of all errors scored, m."""
        errors = self.error[self.scored]
        return float(np.quantile(errors, share)) if errors.size else float("nan")

    @cached_property
    def ate(self) -> Floats:
        """[R]: root mean square over a UAV's steps, mean over UAVs, m."""
        tracks = metrics.rmse_per_track(self.error, self.scored)
        return np.array([metrics.mean(run) for run in tracks])

    @cached_property
    def fge(self) -> Floats:
        """[R]: error of the distances between UAVs, m."""
        truth, offset, scored = self.results.worlds.truth, self.one.offset, self.scored
        return np.array(
            [
                metrics.formation_error(truth[r : r + 1], offset[r : r + 1], scored[r : r + 1])
                for r in range(len(truth))
            ]
        )

    def drift(self) -> Floats:
        """[R]: RMSE of the last hundred steps as a multiple of that of steps 10 to 110; NaN for
        runs too short to have both."""
        if self.error.shape[1] < START.stop - END.start:
            return np.full(len(self.error), np.nan)
        first, last = (
            metrics.rmse_per_run(self.error[:, part], self.scored[:, part]) for part in (START, END)
        )
        return last / first

    def restless(self) -> Floats:
        """[R]: standard deviation over steps of the team's RMS error, m; the first ten, which
        settle, aside."""
        settled = slice(min(10, self.error.shape[1] // 2), None)
        error, scored = self.error[:, settled], self.scored[:, settled]
        squares = np.where(scored, error.astype(np.float64), 0.0) ** 2
        return np.sqrt(squares.sum(2) / np.maximum(scored.sum(2), 1)).std(1)

    def ratio_to(self, bound: Bound | None) -> float:
        """RMSE as a multiple of a bound's over the bound's own runs, where it is finite."""
        if bound is None or len(bound.mse) > len(self.error):
            return float("nan")
        mse, scored = bound.mse.numpy(), bound.scored.numpy()
        told = scored & np.isfinite(mse)
        error = self.error[: len(mse)]
        if not told.any():
            return float("nan")
        return metrics.rmse(error, told) / float(np.sqrt(mse[told].mean()))


def told_by(bound: Bound) -> float:
    """RMSE (m) that a bound allows, of the UAVs that it says are localizable."""
    return bound.rmse_localizable if isinstance(bound, SnapshotBound) else bound.rmse


def better(ours: Runs, other: Runs) -> Difference:
    """By how many per cent the RMSE is lower, paired by the worlds that both met."""
    return gain(*paired(ours.rmse, other.rmse))


def paired(one: Floats, other: Floats) -> tuple[Floats, Floats]:
    """Two figures per run, of the runs that both have."""
    count = min(len(one), len(other))
    return one[:count], other[:count]
