"""Figures of merit of runs: convergence of every holder about everybody, and the worst error."""

import numpy as np

from training.evaluation.metrics import Flags, Floats
from training.reproduce.runs import AgentRuns


class Runs(AgentRuns):
    """An agent's runs in a variant, as teams that agree are looked at."""

    @property
    def steps(self) -> int:
        return self.one.error.shape[1]

    def converged(self, steps: int) -> Flags:
        """[R]: whether, after so many steps (the last, if there are fewer), every holder's pose of
        every UAV is within 0.3 m and 10°; never in a run with NaN or a numerical error."""
        close = self.one.series["converged"][:, min(steps, self.steps) - 1, 0] > 0
        return close & ~self.one.broken

    def worst(self, steps: int) -> Floats:
        """[R]: the largest position error over holders and UAVs after so many steps, m."""
        error = self.one.series["team_error"][:, min(steps, self.steps) - 1]
        return np.where(np.isfinite(error), error, np.inf).max(-1)

    def over_time(self) -> Floats:
        """[K]: share of the runs that have converged."""
        close = self.one.series["converged"][:, :, 0] > 0
        return (close & ~self.one.broken[:, None]).mean(0)

    def nees(self) -> float:
        """Mean over the second half of the runs' steps."""
        half = self.steps // 2
        values = self.one.nees[:, half:][self.results.worlds.scored[:, half:]]
        return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")
