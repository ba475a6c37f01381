"""Tasks on every library's face; each takes a task by name, with its options, or one that is built.

Importing ``agents.tasks`` registers every task with PettingZoo (``pettingzoo.make("parallel",
"coloc/survey-v0")``, and ``"aec"``) and Gymnasium (``gymnasium.make("coloc/survey-v0")``: one UAV).
"""

from typing import TYPE_CHECKING, Any

import torch
from pettingzoo import AECEnv

from agents.tasks.registry import make_task
from agents.tasks.task import Task
from coloc_env.envs import pettingzoo

if TYPE_CHECKING:
    from coloc_env.envs.sb3 import CoLocVecEnv
    from coloc_env.envs.torchrl import CoLocEnv


def parallel_env(
    task: str | Task, render_mode: str | None = None, **options: Any
) -> pettingzoo.CoLocParallelEnv:
    """A task as a PettingZoo parallel environment. ValueError for an unknown task or option."""
    made = built(task, options)
    return pettingzoo.parallel_env(made.scenario, render_mode, made)


def env(task: str | Task, render_mode: str | None = None, **options: Any) -> AECEnv:
    """The same in PettingZoo's agent-environment-cycle form."""
    made = built(task, options)
    return pettingzoo.env(made.scenario, render_mode, made)


def torchrl_env(
    task: str | Task,
    num_envs: int = 1,
    device: str | torch.device = "cpu",
    seed: int | None = None,
    **options: Any,
) -> "CoLocEnv":
    """``num_envs`` worlds of a task as one TorchRL environment; its ``group_map`` has one group."""
    from coloc_env.envs.torchrl import CoLocEnv  # TorchRL takes seconds to import

    made = built(task, options)
    return CoLocEnv(made.scenario, num_envs, device, seed, made)


def vec_env(
    task: str | Task, num_worlds: int = 1, seed: int | None = None, **options: Any
) -> "CoLocVecEnv":
    """Every UAV of ``num_worlds`` worlds of a task as an environment of a stable-baselines3
    ``VecEnv``."""
    from coloc_env.envs.sb3 import CoLocVecEnv

    made = built(task, options)
    return CoLocVecEnv(made.scenario, num_worlds, seed, made)


def built(task: str | Task, options: dict[str, Any]) -> Task:
    """The task of a name, with options; one that is built takes none."""
    if isinstance(task, str):
        return make_task(task, **options)
    if options:
        raise ValueError(f"{task.name}: {next(iter(options))} is an option of tasks by name")
    return task
