"""Wrappers of the PettingZoo face."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from pettingzoo.utils import BaseParallelWrapper

from coloc_env.envs.action_mode import ActionMode
from coloc_env.envs.actions import chosen_leaves
from coloc_env.envs.pettingzoo import CoLocParallelEnv
from coloc_env.observation import flat_box

Observations = dict[str, np.ndarray]


class Flatten(BaseParallelWrapper):
    """Flat observations: the ``leaves`` side by side in one Box (default: those that the action
    mode recommends, else all), for libraries that take no Dict."""

    def __init__(self, env: CoLocParallelEnv, leaves: Sequence[str] | None = None) -> None:
        super().__init__(env)
        chosen = chosen_leaves(env.scenario, env.mode, leaves)
        self.leaves, self._wanted, self._space = tuple(chosen), leaves, flat_box(chosen)
        self.observation_spaces = dict.fromkeys(env.possible_agents, self._space)

    def observation_space(self, agent: str) -> gym.spaces.Box:
        """The same space object for every agent and call."""
        return self._space

    def with_action(self, action: str | ActionMode) -> "Flatten":
        """The same flat environment in another action mode."""
        return Flatten(self.env.with_action(action), self._wanted)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._flat(observations), infos

    def step(self, actions: dict[str, np.ndarray]) -> Any:
        observations, *rest = self.env.step(actions)
        return (self._flat(observations), *rest)

    def _flat(self, observations: dict[str, dict[str, np.ndarray]]) -> Observations:
        return {
            agent: np.concatenate([seen[name] for name in self.leaves])
            for agent, seen in observations.items()
        }
