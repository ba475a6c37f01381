"""An agent's runs in a variant, as papers' figures and claims look at them."""

from dataclasses import dataclass

from training.evaluation.metrics import Flags, Floats
from training.evaluation.record import RunRecord
from training.evaluation.results import Evaluation


@dataclass(frozen=True, eq=False)
class AgentRuns:
    """An agent's runs in a variant."""

    results: Evaluation
    agent: str

    @property
    def one(self) -> RunRecord:
        return self.results.agents[self.agent]

    @property
    def error(self) -> Floats:
        """[R, K, N] m."""
        return self.one.error

    @property
    def scored(self) -> Flags:
        """[R, K, N]."""
        return self.results.worlds.scored
