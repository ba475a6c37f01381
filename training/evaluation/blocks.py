"""Units of work of an evaluation: blocks of consecutive worlds for each agent, and the bound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import torch

from agents.localizer import Localizer
from agents.registry import make
from coloc_env.bounds import Bound, posterior_bound
from coloc_env.scenario import Scenario
from training.evaluation.record import RunRecord, record
from training.identity import code_of, weights_of

_CODE = ("training.evaluation.record",)


@dataclass(frozen=True, eq=False)
class Team:
    """An agent by name, in a scenario, on a device. Its localizer is made where it runs, and never
    sent."""

    name: str
    scenario: Scenario
    device: str = "cpu"

    @cached_property
    def localizer(self) -> Localizer[Any]:
        """ValueError if it cannot serve the scenario."""
        return make(self.name, self.scenario).to(self.device)

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}


@dataclass(frozen=True, eq=False)
class Block:
    """A team in the worlds of ``runs`` seeds from ``seed`` on, as one batch."""

    team: Team
    seed: int
    runs: int

    @property
    def size(self) -> int:
        """Steps of all runs."""
        return self.runs * self.team.scenario.horizon

    def settings(self) -> dict[str, Any]:
        """What the result depends on beside the scenario, which is sent."""
        localizer = self.team.localizer
        return {
            "weights": weights_of(localizer),
            "code": code_of(self.team.scenario.name, [localizer], _CODE),
            "torch": str(torch.__version__),
        }

    def run(self, progress: Callable[[int], None]) -> RunRecord:
        seeds = torch.arange(self.seed, self.seed + self.runs)
        team = self.team
        return record(team.localizer, team.scenario, seeds, progress, team.device)


@dataclass(frozen=True, eq=False)
class Bounded:
    """The posterior bound of the worlds of ``runs`` seeds from ``seed`` on."""

    scenario: Scenario
    seed: int
    runs: int
    size: int = 1

    def settings(self) -> dict[str, Any]:
        """What the result depends on beside the scenario, which is sent."""
        return {"code": code_of(self.scenario.name), "torch": str(torch.__version__)}

    def run(self, progress: Callable[[int], None]) -> Bound:
        progress(0)
        known = posterior_bound(self.scenario, runs=self.runs, seed=self.seed)
        progress(self.size)
        return known
