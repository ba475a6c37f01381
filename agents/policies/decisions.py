"""Decisions of a learned policy in a task: what it reads, and what its choices stand for."""

from typing import Any

import torch
from jaxtyping import Float32
from torch import Tensor

from agents.policies import candidates
from agents.policies.moves import table
from agents.policies.task_actor import TaskActor
from agents.tasks.memory import TaskMemory
from agents.tasks.task import Task
from agents.weights import untrained


def relations(task: Task, memory: TaskMemory, network: str) -> Float32[Tensor, "B n r K"] | None:
    """What a network reads beside observations: candidates' features, or the vectors between UAVs
    in units of their reach; None for the others."""
    if network == "candidates":
        return candidates.candidates(task, memory)
    if network == "attention":
        p = memory.position[:, : task.n_agents]
        return ((p.unsqueeze(1) - p.unsqueeze(2)) / task.radius).to(torch.float32)
    return None


def relations_width(task: Task, network: str) -> int:
    """How many numbers each relation has; 0 where there are none."""
    return {"candidates": candidates.WIDTH, "attention": task.dim}.get(network, 0)


def require_decisions(task: Task, network: str, moves: str, hold: int) -> None:
    """Raise ValueError for a network, a menu or a time that a task's decisions cannot have."""
    if not task.flat:
        raise ValueError(f"obs=dict does not fit: policies of {task.name} read a flat observation")
    if network == "candidates" and not hasattr(task, "targets_of"):
        raise ValueError(f"network=candidates scores exchanges; {task.name} has none to choose")
    if moves != "none" and task.choices is not None:
        raise ValueError(f"moves={moves} is for velocities; {task.name} has choices of its own")
    if task.scenario.horizon % hold:
        raise ValueError(f"hold={hold} must divide the horizon, {task.scenario.horizon}")


def outputs_of(task: Task, moves: str) -> tuple[int, bool]:
    """How many outputs a policy needs, and whether they are choices."""
    if task.choices is not None:
        return task.choices, True
    if moves != "none":
        return len(table(moves, task.dim)), True
    return task.width, False


def actor_for(
    name: str,
    task: Task,
    seed: int,
    *,
    network: str = "feedforward",
    moves: str = "none",
    hold: int = 1,
    **options: Any,
) -> TaskActor:
    """An untrained network for a task, whose ``name`` carries its options; ``options`` as
    ``TaskActor`` has them. Raises ValueError as ``require_decisions`` does."""
    require_decisions(task, network, moves, hold)
    outputs, discrete = outputs_of(task, moves)
    return untrained(
        TaskActor,
        seed,
        task=name,
        observation=task.leaves["observation"].width,
        outputs=outputs,
        discrete=discrete,
        network=network,
        moves=moves,
        hold=hold,
        features=relations_width(task, network),
        **options,
    )
