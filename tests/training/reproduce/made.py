"""Made-up results: what claims, goals, tables and figures of a study are made from."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from coloc_env.bounds import Bound
from coloc_env.scenario import Scenario
from training.evaluation.record import RunRecord, Worlds
from training.evaluation.results import Evaluation
from training.reproduce.results import Runs
from training.reproduce.work import Kind


def runs_of(
    scenario: Scenario,
    error: np.ndarray,
    agent: str = "x",
    series: Mapping[str, np.ndarray] | None = None,
    bound: Bound | None = None,
    nees: float = 3.0,
    worlds: Worlds | None = None,
    offset: np.ndarray | None = None,
) -> Runs:
    """An agent's runs with these errors [R, K, N] (m), along x unless said otherwise."""
    error = error.astype(np.float32)
    if offset is None:
        rest = [0 * error] * (scenario.arena.dim - 1)
        offset = np.stack((error, *rest), -1)
    if worlds is None:
        shape = (*error.shape, scenario.arena.dim)
        attitude = np.zeros((*error.shape[1:], 4 if scenario.arena.dim == 3 else 1))
        worlds = Worlds(0, np.full(shape, 5.0), attitude, np.ones(error.shape, bool))
    own = {key: values.astype(np.float32) for key, values in (series or {}).items()}
    broken = np.zeros(len(error), bool)
    record = RunRecord(
        worlds, offset, error, np.full(error.shape, nees, np.float32), broken, (), own, 1.0
    )
    return Runs(Evaluation(scenario, worlds, bound, {agent: record}), agent)


class Made:
    """Looks results up by a cell's name, an agent and a kind's label; else by agent and label."""

    def __init__(self, found: Mapping[Any, Any], usual: Mapping[Any, Any] | None = None) -> None:
        self.found, self.usual = dict(found), dict(usual or {})

    def get(self, name: str, agent: str = "", kind: Kind | None = None) -> Any:
        key = (agent,) if kind is None else (agent, kind.label)
        return self.found.get((name, *key), self.usual.get(key))
