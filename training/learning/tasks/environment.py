"""Worlds of a task for learners: decisions held for some steps, and the reward that trains."""

from typing import Any

from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform, TransformedEnv

from agents.policies.decisions import relations, relations_width
from agents.tasks.task import Task
from coloc_env.envs.torchrl import CoLocEnv
from training.learning.tasks.rewards import REWARDS


class Decisions(Transform):
    """Each action is held for ``hold`` steps, whose rewards add up.

    The reward becomes the one that trains, ``REWARDS[reward]``; the task's own goes under
    ``score`` [B, 1], the team's mean. What the network reads beside observations goes under
    ``("uav", "relations")``.
    """

    def __init__(self, task: Task, hold: int, reward: str, network: str) -> None:
        super().__init__()
        self.task, self.hold, self.network = task, hold, network
        self.reward = REWARDS[reward](task)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self.reward.start(self._env.memory)
        rows = tensordict_reset["uav", "observation"]
        tensordict_reset.set("score", rows.new_zeros(len(rows), 1))
        return self._with_relations(tensordict_reset)

    def _step(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase
    ) -> TensorDictBase:
        total = score = 0
        for i in range(self.hold):
            if i:
                next_tensordict = self.parent._step(tensordict)
            own = next_tensordict["uav", "reward"]
            score = score + own.mean(1)
            total = total + self.reward(own, self._env.memory, self._env.world)
        next_tensordict["uav", "reward"] = total
        next_tensordict.set("score", score)
        return self._with_relations(next_tensordict)

    def _with_relations(self, tensordict: TensorDictBase) -> TensorDictBase:
        found = relations(self.task, self._env.memory, self.network)
        if found is not None:
            tensordict["uav", "relations"] = found
        return tensordict

    @property
    def _env(self) -> Any:
        return self.parent.base_env

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        b, n = observation_spec["uav", "observation"].shape[:2]
        observation_spec["score"] = Unbounded((b, 1))
        width = relations_width(self.task, self.network)
        if width:
            each = n if self.network == "attention" else self.task.choices
            observation_spec["uav", "relations"] = Unbounded((b, n, each, width))
        return observation_spec


def environment(
    task: Task, worlds: int, seed: int, *, hold: int, reward: str, network: str
) -> TransformedEnv:
    """``worlds`` worlds of a task from a seed on, for a learner."""
    env: Any = CoLocEnv(task.scenario, worlds, seed=seed, action=task)
    return TransformedEnv(env, Decisions(task, hold, reward, network))
