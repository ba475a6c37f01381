"""Figures of the paper and of recovery, per run, from errors [R, K, N] and resets."""

from dataclasses import dataclass

import numpy as np

from training.evaluation import metrics
from training.evaluation.metrics import Flags, Floats
from training.learning.nnhpff import FAILED
from training.reproduce.runs import AgentRuns

FIRST_CORNER = 100  # step
SETTLED = 20  # step from which a filter's start is over
HELD = 10  # steps that an error must stay small to count as recovered
WITHIN = 100  # steps in which a recovery counts


@dataclass(frozen=True, eq=False)
class Runs(AgentRuns):
    """An agent's runs in a variant."""

    @property
    def resets(self) -> Floats:
        """[R, K, N]: 1 where the main filter was begun anew."""
        series = self.one.series.get("resets_per_run")
        return np.zeros_like(self.error) if series is None else series

    def ale(self) -> Floats:
        """[R]: mean error over a run, m (the paper's averaged localization error)."""
        return metrics.mean_per_run(self.error, self.results.worlds.scored)

    def settled_ale(self) -> Floats:
        """[R]: the same after the first 2 s."""
        return metrics.mean_per_run(
            self.error[:, SETTLED:], self.results.worlds.scored[:, SETTLED:]
        )

    def resets_per_run(self) -> Floats:
        """[R], mean over UAVs."""
        return self.resets.sum(1).mean(-1)

    def corner_peak(self) -> Floats:
        """[R]: largest error on the side after the first corner, m; NaN for runs cut before it."""
        side = self.error[:, FIRST_CORNER : 2 * FIRST_CORNER]
        return side.max(1).mean(-1) if side.size else np.full(len(side), np.nan)

    def first_reset(self, after: int = FIRST_CORNER) -> Floats:
        """[R]: step of the first reset from step ``after`` on; infinity if there is none."""
        late = self.resets[:, after:, 0] > 0
        if not late.size:
            return np.full(len(late), np.inf)
        return np.where(late.any(1), after + late.argmax(1), np.inf)

    def recovery(self, step: int, uavs: slice) -> Floats:
        """[R, n]: seconds from ``step`` until the errors of some UAVs stay small for a second;
        infinity if that takes more than 10 s."""
        late = self.error[:, step : step + WITHIN + HELD, uavs] < FAILED
        windows = np.lib.stride_tricks.sliding_window_view(late, HELD, 1)
        held: Flags = np.asarray(windows.all(axis=-1))
        first = np.where(held.any(1), held.argmax(1).astype(float), np.inf)
        return self.results.dt * first
