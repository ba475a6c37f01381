"""How good a policy is in the end: returns in the protocol's worlds, which no training uses."""

from collections.abc import Mapping
from typing import Annotated, Any

import torch

from agents.policies.task_actor import TaskActor
from agents.policies.task_policy import TaskPolicy
from agents.tasks import make_task
from agents.tasks.runner import rollout
from coloc_env.options import Quantity
from training.evaluation.score import FIRST_SEED, WORLDS
from training.learning.run import Progress

ScoreWorlds = Annotated[int, Quantity("", 0, WORLDS)]


def score(actor: TaskActor, worlds: int, progress: Progress) -> Mapping[str, Any]:
    """Mean return, with its standard error, in the first so many of the protocol's worlds."""
    if worlds == 0:
        return {}
    task = make_task(actor.architecture["task"]).with_options(reward="true")
    policy = TaskPolicy(task, actor)
    total = torch.zeros(worlds, dtype=torch.float64)
    horizon = task.scenario.horizon
    for i, step in enumerate(rollout(task, policy, FIRST_SEED + torch.arange(worlds))):
        total += step.reward.double().mean(-1)
        progress("scoring", i + 1, horizon)
    spread = float(total.std() / worlds**0.5) if worlds > 1 else 0.0
    return {
        "worlds": worlds,
        "first_seed": FIRST_SEED,
        "return": float(total.mean()),
        "standard_error": spread,
    }
