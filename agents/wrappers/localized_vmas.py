"""Localization in the loop of VMAS scenarios."""

from typing import Any

import torch
from torch import Tensor

from agents.wrappers.adapter import Adapter
from agents.wrappers.entries import replaced
from agents.wrappers.localization import Localization
from coloc_env.seeding import MOST


def localized_vmas(
    scenario: Any, task: Adapter, localizer: str = "ekf", std: bool = False, **overrides: Any
) -> Any:
    """A VMAS scenario (``BaseScenario``) whose agents are localized, for ``vmas.make_env`` and
    TorchRL's ``VmasEnv``: as ``Localized``, batched.

    ``scenario``: an instance that no environment has been made of; it is changed in place and
    returned. ``task.positions`` and ``task.entries`` are given the scenario. Observations must be
    flat tensors. Infos have ``localization_error`` (m). The noise follows VMAS's seed, and draws
    nothing from VMAS's random numbers: the task goes as it does without localization.
    """
    kind = type(scenario)

    class LocalizedScenario(kind):  # type: ignore[misc, valid-type]
        team: Localization | None = None
        _episodes = 0

        def reset_world_at(self, env_index: int | None = None) -> None:
            super().reset_world_at(env_index)
            places, rows = task.places(self), None
            if self.team is None:
                self.team = task.localization(localizer, places, **overrides)
            elif env_index is not None:
                rows = torch.arange(len(places)) == env_index
            with torch.random.fork_rng(devices=[]):
                seeds = torch.randint(MOST, (len(places),))
            self._episodes += 1
            self.team.restart(places, (seeds + self._episodes) % MOST, rows)

        def post_step(self) -> None:
            super().post_step()
            self._localized().move(task.places(self))

        def observation(self, agent: Any) -> Tensor:
            seen, i, team = super().observation(agent), self._number(agent), self._localized()
            if not isinstance(seen, Tensor) or seen.ndim != 2:
                raise ValueError(f"Localized: {agent.name} observes no flat tensor")
            known = replaced(seen.cpu(), task.entries(self, i), task.places(self), team, i, self)
            if std:
                known = torch.cat((known, team.std[:, i].to(known)), -1)
            return known.to(seen)

        def info(self, agent: Any) -> dict[str, Tensor]:
            error = self._localized().error[:, self._number(agent)]
            return {**super().info(agent), "localization_error": error.to(self.world.device)}

        def _number(self, agent: Any) -> int:
            found: int = self.world.policy_agents.index(agent)
            return found

        def _localized(self) -> Localization:
            assert self.team is not None
            return self.team

    scenario.__class__ = LocalizedScenario
    return scenario
