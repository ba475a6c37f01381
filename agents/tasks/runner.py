"""A policy in a task's worlds, many at once: what scores are made of."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from agents.tasks.memory import TaskMemory
from agents.tasks.rules import Policy, Seen
from agents.tasks.task import Task
from coloc_env.envs.action_checks import checked_tensor
from coloc_env.envs.mode_runner import ModeRunner
from coloc_env.world import World


@dataclass(frozen=True)
class TaskStep:
    """What was ``seen``, the ``action`` and its ``reward`` [B, n]; ``world`` and ``memory`` after
    the step, and the ``error`` [B, N] (m) there."""

    reward: Float32[Tensor, "B n"]
    action: Tensor
    error: Float32[Tensor, "B N"]
    world: World
    memory: TaskMemory
    seen: Seen


@torch.no_grad()
def rollout(
    task: Task, policy: Policy, seeds: Int64[Tensor, "B"], seed: int = 0
) -> Iterator[TaskStep]:
    """One episode in each of the worlds of ``seeds``; ``seed``: of the policy's own numbers."""
    world = World(task.scenario, len(seeds))
    runner = ModeRunner(task, world)
    world.reset(seeds)
    leaves, generator = runner.reset(), torch.Generator().manual_seed(seed)
    for _ in range(task.scenario.horizon):
        seen = _seen(task, leaves, runner, generator)
        action = checked_tensor(task.scenario, task, policy(seen), len(seeds))
        step = runner.step(runner.estimate(action))
        leaves = runner.observe()
        error = task.error(runner.memory, world)
        yield TaskStep(step.reward, action, error, world, runner.memory, seen)


def _seen(
    task: Task, leaves: dict[str, Tensor], runner: ModeRunner, generator: torch.Generator
) -> Seen:
    mask = leaves["action_mask"] > 0 if "action_mask" in leaves else None
    return Seen(task, leaves["observation"], mask, runner.memory, generator)
