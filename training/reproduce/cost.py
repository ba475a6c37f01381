"""What agents cost: time of every step, and memory, of the whole team in one world on one thread.

All agents take each step in turn, so that whatever else the machine does slows them alike and
their times can be compared pair by pair.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch

from agents.localizer import Localizer
from agents.registry import make
from coloc_env.scenario import Scenario
from training.evaluation.evaluate import Progress
from training.evaluation.metrics import Floats
from training.evaluation.rollout import Breakdown, rollout
from training.memory import peak_bytes
from training.reproduce.store import Arrays, Facts
from training.reproduce.work import Kind, Piece, Variant

MEMORY = """\
Memory, measured: *belief* is what the team carries from step to step; *working set* is the most
that torch has allocated on top of it at any moment of the run's last step. The interpreter and
libraries, the same for all, are left out. The paper does not say what its figure holds."""
_WARM_UP = 5  # steps taken before those that are timed


@dataclass(frozen=True, eq=False)
class Cost:
    """``ms`` [K] of each step; ``belief`` and ``working`` in bytes."""

    ms: Floats
    belief: int
    working: int

    @property
    def held(self) -> int:
        """Bytes in all."""
        return self.belief + self.working

    @property
    def median(self) -> float:
        """Of the steps' times, ms."""
        return float(np.median(self.ms))

    @property
    def summary(self) -> dict[str, float]:
        """As plain values."""
        return {
            "ms_per_step": float(self.ms.mean()),
            "ms_per_step_std": float(self.ms.std()),
            "ms_per_step_median": self.median,
            "belief_bytes": self.belief,
            "working_set_bytes": self.working,
        }


@torch.no_grad()
def measure(
    scenario: Scenario, agents: Sequence[str], seed: int, progress: Progress
) -> dict[str, Cost]:
    """Cost of each agent over a run; an agent that raises a numerical error has none."""
    teams = {name: _Team(make(name, scenario), scenario, seed) for name in agents}
    ms: dict[str, list[float]] = {name: [] for name in agents}
    warm_up = min(_WARM_UP, scenario.horizon)
    with _one_thread():
        for k in range(warm_up + scenario.horizon):
            for name, team in list(teams.items()):
                if k in (0, warm_up):
                    team.start()
                try:
                    spent = team.step()
                except Breakdown:
                    del teams[name]
                    continue
                if k >= warm_up:
                    ms[name].append(spent)
            progress("cost", k + 1, warm_up + scenario.horizon)
        return {
            name: Cost(np.array(ms[name]), team.last.belief.bytes(), team.peak())
            for name, team in teams.items()
        }


def compute(piece: Piece, progress: Progress) -> tuple[Arrays, Facts]:
    """``measure`` the agents of a piece."""
    found = measure(piece.variant.build(), piece.agents, piece.seed, progress)
    facts = {agent: [one.belief, one.working] for agent, one in found.items()}
    return {agent: one.ms for agent, one in found.items()}, facts


def load(variant: Variant, arrays: Arrays, facts: Facts) -> dict[str, Cost]:
    """What ``compute`` found, by agent."""
    return {agent: Cost(arrays[agent], *facts[agent]) for agent in facts}


COST = Kind("cost", f"{__name__}:compute", f"{__name__}:load", together=True)


class _Team:
    """A team in a world of its own."""

    def __init__(self, localizer: Localizer, scenario: Scenario, seed: int) -> None:
        self.localizer, self.scenario, self.seeds = localizer, scenario, torch.tensor([seed])

    def start(self) -> None:
        self._steps = rollout(self.localizer, self.scenario, self.seeds)

    def step(self) -> float:
        """One step on; the localizer's time in ms."""
        self.last = next(self._steps)
        return 1e3 * self.last.seconds

    def peak(self) -> int:
        """Bytes allocated at the height of the last step."""
        last = self.last
        return peak_bytes(lambda: self.localizer.step(last.belief, last.observation))


@contextmanager
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
