"""An action mode at work in the worlds of an environment."""

from typing import Any

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from coloc_env.commands import Commands
from coloc_env.envs.action_mode import ActionMode, Leaves
from coloc_env.world import Step, World


class ModeRunner:
    """An action mode at work in the worlds of one environment: it keeps their memory.

    The leaves that it gives are copies, which agents may edit.
    """

    def __init__(self, mode: ActionMode, world: World) -> None:
        self.mode, self.world = mode, world
        self.width = mode.width
        self._adds_nothing = not mode.leaves and type(mode).reset is ActionMode.reset
        self._started = self._ahead = False
        self._commands = Commands()
        self._memory: Any = None
        self._leaves: Leaves = {}

    def reset(self, rows: Bool[Tensor, "B"] | None = None) -> Leaves:
        """Restart the rows that have been reset (None: all) and return every row's leaves at the
        current step."""
        if self._adds_nothing:
            return {}
        observation = self.world.observation()
        fresh, leaves = self.mode.observe(self.mode.reset(observation), observation)
        if rows is not None and self._started and not bool(rows.all()):
            chosen = rows[:, None].expand(observation.batch_size)
            fresh = None if fresh is None else fresh.where(chosen, self._memory)
            leaves = {
                name: torch.where(rows[:, None, None], leaf, self._leaves[name])
                for name, leaf in leaves.items()
            }
        self._memory, self._leaves, self._started, self._ahead = fresh, leaves, True, False
        return self._copies()

    def observe(self) -> Leaves:
        """The leaves at the step that the worlds have moved to."""
        if self._adds_nothing:
            return {}
        if self._ahead:
            self._ahead = False
        else:
            self._memory, self._leaves = self.mode.observe(self._memory, self.world.observation())
        return self._copies()

    def _copies(self) -> Leaves:
        return {name: leaf.clone() for name, leaf in self._leaves.items()}

    def estimate(self, action: Float32[Tensor, "B n a"]) -> Float32[Tensor, "B N A"]:
        """The estimates that actions stand for; what they command waits for ``step``."""
        self._memory, estimates = self.mode.estimate(self._memory, action)
        self._commands = self.mode.commands(self._memory, action)
        return estimates

    def step(self, estimates: Float32[Tensor, "B N A"]) -> Step:
        """Move the worlds on, estimates scored and commands obeyed; rewards are the mode's."""
        step = self.world.step(estimates, self._commands)
        if not self.mode.rewards:
            return step
        self.observe()
        self._ahead = True
        self._memory, reward = self.mode.reward(self._memory, self.world)
        return step._replace(reward=reward)

    @property
    def memory(self) -> Any:
        """The mode's memory at the step last observed."""
        return self._memory

    def state(self) -> Float32[Tensor, "B S"]:
        """What a critic may know."""
        return self.mode.state(self._memory, self.world)
