"""The protocol of tasks: how good a policy is, on worlds that no training ever uses.

returns of 256 fixed worlds → mean, interquartile mean with a bootstrap interval, share of the
span from random to the best heuristic, what others' randomness costs, what ranges between UAVs
are worth.
"""

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents.tasks import make_task
from agents.tasks.runner import rollout
from agents.tasks.rules import Policy, Seen
from agents.tasks.task import Task

FIRST_SEED = 10**9  # of the protocol's worlds; trainings use seeds below
WORLDS = 256
_RESAMPLES = 2000

Floats = NDArray[np.float64]


def score(
    task_name: str,
    policy_name: str,
    worlds: int = WORLDS,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> dict[str, Any]:
    """All figures of a policy in a task, as JSON can hold them.

    ``policy_name``: a heuristic of the task, or ``module:function`` of one's own, which takes a
    ``Seen`` and returns actions. Raises ValueError for an unknown task or policy, and for actions
    that do not fit.
    """
    task = make_task(task_name)
    policy = find_policy(task, policy_name)
    seeds = torch.arange(FIRST_SEED, FIRST_SEED + worlds)
    jobs: dict[str, tuple[Task, Policy]] = {
        "policy": (task, policy),
        "random": (task, task.policies["random"]),
        "best": (task, task.policies[task.best]),
        "others_random": (task, _with_others(policy, task.policies["random"])),
    }
    jobs["no_uav_ranges"] = (task.without_cooperation(), policy)
    found: dict[str, dict[str, Floats]] = {}
    for i, (name, (where, who)) in enumerate(jobs.items()):
        progress(task_name, i, len(jobs))
        same = next((n for n in found if jobs[n] == (where, who)), None)
        found[name] = found[same] if same else _run(where, who, seeds)
    progress(task_name, len(jobs), len(jobs))
    own, random, best = (found[n]["team"] for n in ("policy", "random", "best"))
    span = float(best.mean() - random.mean())
    first, mixed = found["policy"]["first"], found["others_random"]["first"]
    low, high = bootstrap(own)
    return {
        "task": task_name,
        "policy": policy_name,
        "worlds": worlds,
        "first_seed": FIRST_SEED,
        "return": float(own.mean()),
        "standard_error": float(own.std(ddof=1) / worlds**0.5),
        "interquartile_mean": interquartile_mean(own),
        "interval_95": [low, high],
        "error": float(found["policy"]["error"].mean()),
        "random": float(random.mean()),
        "best_known": {"policy": task.best, "return": float(best.mean())},
        "share_of_span": float((own.mean() - random.mean()) / span) if span else None,
        "interaction": {
            "uav_0": float(first.mean()),
            "uav_0_others_random": float(mixed.mean()),
            "cost": float((first - mixed).mean()),
        },
        "cooperation": {
            "without_uav_ranges": float(found["no_uav_ranges"]["team"].mean()),
            "worth": float((own - found["no_uav_ranges"]["team"]).mean()),
        },
        "messages": float(found["policy"]["messages"].mean()),
        "bytes": float(found["policy"]["bytes"].mean()),
        "distance": float(found["policy"]["distance"].mean()),
        "returns": own.tolist(),
    }


def find_policy(task: Task, name: str) -> Policy:
    """A heuristic of the task by name, or somebody's own ``module:function``."""
    module, separator, attribute = name.partition(":")
    if not separator:
        return task.policy(name)
    try:
        policy: Policy = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"--policy {name}: {error}") from error
    return policy


def interquartile_mean(values: Floats) -> float:
    """Mean of the middle half (Agarwal et al., NeurIPS 2021)."""
    ordered = np.sort(values)
    cut = len(ordered) // 4
    return float(ordered[cut : len(ordered) - cut].mean())


def bootstrap(values: Floats, level: float = 0.95) -> tuple[float, float]:
    """Percentile interval of the interquartile mean over worlds drawn with replacement."""
    draws = np.random.default_rng(0).integers(0, len(values), (_RESAMPLES, len(values)))
    ordered = np.sort(values[draws], axis=1)
    cut = len(values) // 4
    means = ordered[:, cut : len(values) - cut].mean(1)
    low, high = np.quantile(means, (0.5 - 0.5 * level, 0.5 + 0.5 * level))
    return float(low), float(high)


def _with_others(policy: Policy, others: Policy) -> Policy:
    """``policy`` for uav_0, ``others`` for the rest."""

    def mixed(seen: Seen) -> Tensor:
        action = others(seen).clone().to(torch.float32)
        action[:, :1] = policy(seen)[:, :1].to(torch.float32)
        return action

    return mixed


def _run(task: Task, policy: Policy, seeds: Tensor) -> dict[str, Floats]:
    """Per world: the team's mean return, that of uav_0, mean error (m), messages, bytes, distance
    travelled (m), of those that act."""
    team = first = error = distance = torch.zeros(len(seeds), dtype=torch.float64)
    before: Tensor | None = None
    n = task.n_agents
    for step in rollout(task, policy, seeds):
        team = team + step.reward.double().mean(-1)
        first = first + step.reward[:, 0].double()
        error = error + step.error.double().mean(-1) / task.scenario.horizon
        now = step.world.truth.position[:, :n]
        if before is not None:
            distance = distance + (now - before).norm(dim=-1).sum(-1)
        before, world = now, step.world
    figures = {"team": team, "first": first, "error": error, "distance": distance}
    figures["messages"] = world.messages_sent[:, :n].sum(-1)
    figures["bytes"] = world.bytes_sent[:, :n].sum(-1)
    return {name: value.double().numpy() for name, value in figures.items()}
