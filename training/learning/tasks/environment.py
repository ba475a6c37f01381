"""Worlds of a task for learners: decisions held for some steps, and what networks read besides."""

from typing import Any

from jaxtyping import Float32
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform, TransformedEnv

from agents.parts import move
from agents.policies.decisions import relations, relations_width
from agents.tasks.memory import TaskMemory
from agents.tasks.task import Task
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.world import World
from training.learning.tasks.rewards import Difference


class Decisions(Transform):
    """Each action is held for ``hold`` steps, whose rewards add up.

    Rewards are the task's, or, with ``difference``, what each call was worth to the team. What
    scores are made of, the team's mean reward of the true error, goes under ``score`` [B, 1]; what
    the network reads beside observations, under ``("uav", "relations")``.
    """

    def __init__(self, task: Task, hold: int, difference: bool, network: str) -> None:
        super().__init__()
        self.task, self.hold, self.network = task, hold, network
        self.difference = Difference(task) if difference else None
        self.true = task.with_options(reward="true")
        self.counted: dict[str, Tensor] = {}

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        if self.difference is not None:
            self.difference.start(self._env.memory)
        self.start, self.counted = dict(self._env.memory.more.items()), {}
        rows = tensordict_reset["uav", "observation"]
        tensordict_reset.set("score", rows.new_zeros(len(rows), 1))
        return self._with_relations(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        total: Any = 0
        score: Any = 0
        for i in range(self.hold):
            if i:
                next_tensordict = self.parent._step(tensordict)
            memory, world = self._env.memory, self._env.world
            own = next_tensordict["uav", "reward"]
            score = score + self._true(own, memory, world).mean(1)
            total = total + (own if self.difference is None else self.difference(memory, world))
        next_tensordict["uav", "reward"] = total
        next_tensordict.set("score", score)
        return self._with_relations(next_tensordict)

    def _true(
        self, own: Float32[Tensor, "B n 1"], memory: TaskMemory, world: World
    ) -> Float32[Tensor, "B n 1"]:
        """The task's reward of the true error, with counters of its own."""
        if self.task.chosen.reward == "true":
            return own
        if not self.counted:  # of the start: what a reward counts by is what it changes
            changed, _ = self._rewarded(memory, world)
            self.counted = {key: self.start[key] for key in changed}
        counted, reward = self._rewarded(memory, world)
        self.counted |= counted
        return reward.unsqueeze(-1)

    def _rewarded(
        self, memory: TaskMemory, world: World
    ) -> tuple[dict[str, Tensor], Float32[Tensor, "B n"]]:
        """What the reward of the true error changes in the memory, and that reward."""
        before = memory.more.clone(recurse=False).update(self.counted)
        after, reward = self.true.reward(memory.replace(more=before.clone(recurse=False)), world)
        return {k: v for k, v in after.more.items() if v is not before[k]}, reward

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
        where = self.parent.device
        observation_spec["score"] = Unbounded((b, 1), device=where)
        width = relations_width(self.task, self.network)
        if width:
            each = n if self.network == "attention" else self.task.choices
            observation_spec["uav", "relations"] = Unbounded((b, n, each, width), device=where)
        return observation_spec


def environment(
    task: Task,
    worlds: int,
    seed: int,
    device: str,
    *,
    hold: int,
    difference: bool,
    network: str,
) -> TransformedEnv:
    """``worlds`` worlds of a task from a seed on, for a learner."""
    move(task, device)
    env: Any = CoLocEnv(task.scenario, worlds, device, seed=seed, action=task)
    return TransformedEnv(env, Decisions(task, hold, difference, network))
