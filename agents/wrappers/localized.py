"""Localization in the loop of other people's tasks: their agents no longer see where they are, but
what a localizer makes of what they sense. Rewards stay the task's."""

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from pettingzoo import ParallelEnv
from torch import Tensor

from agents.wrappers.adapter import Adapter, NoiseSeeds
from agents.wrappers.entries import replaced
from coloc_env.seeding import checked_seed


class Localized(ParallelEnv[Any, Any, Any]):
    """A PettingZoo parallel environment whose agents are localized; ``task`` says where they are.

    Its agents are sensed like UAVs (``overrides``: options of
    ``coloc_env.scenarios.followed``, such as ``anchors=4``, ``nlos=0.3``, ``uwb=False``), and a
    ``localizer`` (by name, with options) works out where each is. Observations, flat Boxes, hold
    these estimates wherever the task's hold a place or a velocity; with ``std=True`` the standard
    deviation of the own position per axis, in the task's units, is appended. Infos have each
    agent's ``localization_error`` in m. An agent that has left the task is sensed no more and stays
    where it was last.

    ``reset(seed)`` seeds the task and the noise alike; without a seed the noise of the next
    episodes differs. Raises ValueError for observations that are no flat Boxes, and for a task,
    localizer or overrides that do not fit.
    """

    def __init__(
        self,
        env: ParallelEnv[Any, Any, Any],
        task: Adapter,
        localizer: str = "ekf",
        std: bool = False,
        **overrides: Any,
    ) -> None:
        self.env, self.task, self._std = env, task, std
        self.metadata = env.metadata
        self.possible_agents = list(env.possible_agents)
        self._seeds = NoiseSeeds()
        dim = len(task.low)
        self.observation_spaces = {
            agent: self._space(agent, env.observation_space(agent), dim * std)
            for agent in self.possible_agents
        }
        nowhere = torch.zeros(1, len(self.possible_agents), dim)
        self.team = task.localization(localizer, nowhere, **overrides)

    @staticmethod
    def _space(agent: Any, space: spaces.Space[Any], extra: int) -> spaces.Box:
        """Estimates have no bounds: anything finite."""
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"Localized: {agent} observes {space}: a flat Box is needed")
        shape = (space.shape[0] + extra,)
        return spaces.Box(-np.inf, np.inf, shape, space.dtype.type)

    def observation_space(self, agent: Any) -> spaces.Box:
        """A flat Box without bounds, the same object each call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: Any) -> spaces.Space[Any]:
        """The task's."""
        return self.env.action_space(agent)

    @property
    def agents(self) -> list[Any]:
        return self.env.agents

    @property
    def unwrapped(self) -> Any:
        return self.env.unwrapped

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[Any, np.ndarray], dict[Any, dict[str, Any]]]:
        if seed is not None:
            self._seeds.next = checked_seed(seed, "Localized")
        observations, infos = self.env.reset(seed=seed, options=options)
        places = self.task.places(self.env)
        self.team.restart(places, self._seeds.take(1))
        return self._known(observations, places), self._infos(infos)

    def step(self, actions: dict[Any, Any]) -> tuple[Any, Any, Any, Any, Any]:
        self.team.require_start()
        observations, rewards, ended, cut, infos = self.env.step(actions)
        places = self.task.places(self.env)
        self.team.move(places)
        return self._known(observations, places), rewards, ended, cut, self._infos(infos)

    def _known(self, observations: dict[Any, np.ndarray], places: Tensor) -> dict[Any, np.ndarray]:
        found = {}
        for i, agent in enumerate(self.possible_agents):
            if agent not in observations:
                continue
            row = torch.from_numpy(np.array(observations[agent])).unsqueeze(0)
            entries = self.task.entries(self.env, i)
            known = replaced(row, entries, places, self.team, i, self.env)[0]
            if self._std:
                known = torch.cat((known, self.team.std[0, i].to(known.dtype)))
            found[agent] = known.numpy()
        return found

    def _infos(self, infos: dict[Any, dict[str, Any]]) -> dict[Any, dict[str, Any]]:
        error = dict(zip(self.possible_agents, self.team.error[0].tolist(), strict=True))
        return {a: {**info, "localization_error": error[a]} for a, info in infos.items()}

    def render(self) -> Any:
        return self.env.render()

    def close(self) -> None:
        self.env.close()

    def state(self) -> np.ndarray:
        """The task's: privileged."""
        return np.asarray(self.env.state())
