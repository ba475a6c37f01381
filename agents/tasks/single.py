"""One UAV of a task as a Gymnasium environment; a policy acts for the others."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch

from agents.tasks.faces import built
from agents.tasks.rules import Seen
from agents.tasks.task import Task
from coloc_env.envs.action_checks import checked_arrays, checked_tensor
from coloc_env.envs.actions import action_space
from coloc_env.envs.mode_runner import ModeRunner
from coloc_env.observation import flat_box
from coloc_env.seeding import checked_seed, random_seed
from coloc_env.world import World


class SingleAgentTask(gym.Env[np.ndarray, Any]):
    """``uav_0`` of a task, by name, with its options, or built; ``others``: the heuristic for the
    rest (None: the best that is known).

    Observations are flat float32 [F] within [−1, 1]; where actions are choices, infos have their
    ``action_mask`` [choices] int8. The horizon truncates. Raises ValueError for an unknown policy.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (Gymnasium's convention)

    def __init__(self, task: str | Task, others: str | None = None, **options: Any) -> None:
        self.task = built(task, options)
        if not self.task.flat:
            raise ValueError(f"{self.task.name}: obs='dict' is not allowed here: flat")
        self.others = self.task.policy(others or self.task.best)
        self.world = World(self.task.scenario)
        self._runner = ModeRunner(self.task, self.world)
        self._next_seed: int | None = None
        self.observation_space = flat_box({"observation": self.task.leaves["observation"]})
        self.action_space = action_space(self.task)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode: the world of ``seed``; without one, of the seed after the last (the
        first time: a random one). The info has it."""
        if seed is None:
            seed = random_seed() if self._next_seed is None else self._next_seed
        self.seed = checked_seed(seed, self.task.name)
        super().reset(seed=self.seed)
        self._next_seed = self.seed + 1
        self.world.reset([self.seed])
        self._leaves = self._runner.reset()
        self._random = torch.Generator().manual_seed(self.seed)
        return self._observe(), self._info()

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Act, and let the others act by what they see. ValueError for an action that does not fit,
        and before the first ``reset()``."""
        task = self.task
        if self.world.cursor < 0:
            raise ValueError(f"{task.name}: call reset() first")
        own = checked_arrays(task.scenario, task, {"uav_0": action}, ["uav_0"])
        mask = self._leaves["action_mask"] > 0 if "action_mask" in self._leaves else None
        observation = self._leaves["observation"]
        seen = Seen(task, observation, mask, self._runner.memory, self._random)
        actions = self.others(seen).to(torch.float32).clone()
        actions[0, 0] = torch.from_numpy(own[0:1])[0]
        actions = checked_tensor(task.scenario, task, actions, 1)
        step = self._runner.step(self._runner.estimate(actions))
        self._leaves = self._runner.observe()
        over = bool(step.truncated[0])
        return self._observe(), float(step.reward[0, 0]), False, over, self._info()

    def _observe(self) -> np.ndarray:
        return self._leaves["observation"][0, 0].numpy()

    def _info(self) -> dict[str, Any]:
        info: dict[str, Any] = {"seed": self.seed}
        if "action_mask" in self._leaves:
            info["action_mask"] = self._leaves["action_mask"][0, 0].numpy().astype(np.int8)
        return info
