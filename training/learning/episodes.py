"""Whole episodes under policies that learn nothing meanwhile: units of work for any workers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.scenario import Scenario
from training.identity import code_of
from training.learning.collectors import Batches, EpochCollector, episode_collector
from training.pool import ALONE, Workers, work


@dataclass(frozen=True, eq=False)
class Episode:
    """``worlds`` worlds of a scenario, seeded from ``seed`` on, from their start to the horizon."""

    scenario: Scenario
    worlds: int
    seed: int
    policy: TensorDictModuleBase
    size: int = 1
    device: str = "cpu"

    def settings(self) -> dict[str, Any]:
        """What the result depends on beside scenario and policy, which are sent."""
        code = code_of(self.scenario.name, modules=(__name__, "agents.policies.adapters"))
        versions = [metadata.version(name) for name in ("torch", "torchrl", "tensordict")]
        return {"code": code, "versions": versions}

    def run(self, progress: Callable[[int], None]) -> TensorDict:
        """The episode as one batch [worlds, horizon]."""
        env = CoLocEnv(self.scenario, self.worlds, self.device, seed=self.seed)
        collector = episode_collector(env, self.policy, self.scenario.horizon, compact_obs=True)
        (batch,) = (batch.to_tensordict() for batch in collector)
        collector.shutdown()
        progress(self.size)
        return batch


class Episodes:
    """The episodes of one epoch in one batch, row by row, whoever the ``workers`` are."""

    def __init__(self, episodes: Sequence[Episode]) -> None:
        self.episodes, self.workers = episodes, ALONE

    def __iter__(self) -> Iterator[TensorDictBase]:
        batches: dict[Episode, TensorDict] = {}
        for found in work(self.episodes, self.workers, lambda episode, size: None):
            if found.error is not None:
                raise found.error
            batches[found.unit] = found.result
        yield torch.cat([batches[episode] for episode in self.episodes])

    def shutdown(self) -> None:
        """Nothing is left running."""


def spread(training: str, collector: object, workers: Workers) -> None:
    """Let workers run an ``EpochCollector``'s episodes. ValueError for a training whose rollouts
    others cannot run: its policy learns between an episode's batches, or draws from a generator
    that all its worlds share."""
    batches = collector.make(0) if isinstance(collector, EpochCollector) else None
    if not isinstance(collector, EpochCollector) or not isinstance(batches, Episodes):
        raise ValueError(
            f"{training} learns while its episodes run: to spread them would change its numbers; "
            "--ray and --jobs serve nnhpff, and `coloc reproduce --ray` spreads whole trainings"
        )

    def given(batches: Batches) -> Batches:
        assert isinstance(batches, Episodes)
        batches.workers = workers
        return batches

    collector.prepare = given
