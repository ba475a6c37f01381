"""All that the paper's part reports from."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from training.evaluation import metrics
from training.evaluation.metrics import Difference, Floats
from training.evaluation.results import Evaluation
from training.reproduce.cost import Cost
from training.reproduce.pfnn.in_flight import InFlight
from training.reproduce.verdicts import Claim

STEADY = 10.0  # s: from here on a filter has settled


@dataclass(frozen=True, eq=False)
class Flown:
    """``tables``: all agents over the tables' runs; ``cdf``: those of table 4 over figure 9's;
    ``cost`` of those of table 5; ``learning``: None if ``pfnn`` was not wanted."""

    tables: Evaluation
    cdf: Evaluation
    cost: dict[str, Cost]
    learning: InFlight | None

    def rmse(self, agent: str) -> Floats:
        """[R], m."""
        return metrics.rmse_per_run(self.error(agent), self.tables.worlds.scored)

    def largest(self, agent: str) -> Floats:
        """[R]: mean over UAVs of the largest error, m."""
        return np.where(self.tables.worlds.scored, self.error(agent), 0.0).max(1).mean(1)

    def mean(self, agent: str) -> Floats:
        """[R]: mean error, m."""
        return metrics.mean_per_run(self.error(agent), self.tables.worlds.scored)

    def particles(self, agent: str) -> Floats | None:
        """[R], None for what has no particles."""
        values = self.tables.agents[agent].series.get("particles")
        return None if values is None else metrics.mean_per_run(values, self.tables.worlds.scored)

    def error(self, agent: str) -> Floats:
        """[R, K, N], m."""
        return self.tables.agents[agent].error

    @property
    def steady(self) -> slice:
        """The steps after the first 10 s; all of a run that is shorter."""
        first = round(STEADY / self.tables.dt)
        return slice(first if first < self.tables.scenario.horizon else 0, None)


class Case(NamedTuple):
    """A claim, the agents it speaks of, and the figure of ours that decides it."""

    claim: Claim
    needs: tuple[str, ...]
    figure: Callable[[Flown], Difference | None]
