"""The protocol of tasks: how good a policy is, on worlds that no training ever uses.

Returns of 256 fixed worlds → mean, interquartile mean with a bootstrap interval, share of the span
from random to the best heuristic, what others' randomness costs, what ranges between UAVs are
worth. Returns are of the true error, whatever a policy was trained on.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import trim_mean
from torch import Tensor

from agents.tasks import make_task
from agents.tasks.rules import Policy, Seen
from agents.tasks.runner import rollout
from agents.tasks.task import Task
from coloc_env.effort import Effort
from training.evaluation.task_policies import find_policies

FIRST_SEED = 10**9  # of the protocol's worlds; trainings use seeds below
WORLDS = 256
_RESAMPLES = 2000

Floats = NDArray[np.float64]
Progress = Callable[[str, int, int], None]


def score(
    task_name: str,
    policy: str | Policy,
    worlds: int = WORLDS,
    progress: Progress = lambda what, done, total: None,
) -> dict[str, Any]:
    """All figures of a policy in a task, as JSON can hold them.

    ``policy``: a function from a ``Seen`` to actions, or the name of one (``find_policies``), or of
    several seeds' weights, separated by commas. Raises ValueError for an unknown task or policy,
    and for actions that do not fit.
    """
    task = make_task(task_name).with_options(reward="true", obs="flat")
    seeds = torch.arange(FIRST_SEED, FIRST_SEED + worlds)
    policies = find_policies(task, policy) if isinstance(policy, str) else [policy]
    chance, good = task.policies["random"], task.policy(task.best)
    jobs: list[tuple[str, Task, Policy]] = []
    for each in policies:
        jobs += [
            ("policy", task, each),
            ("others_random", task, _with_others(each, chance)),
            ("no_uav_ranges", task.without_cooperation(), each),
        ]
    jobs += [("random", task, chance), ("best", task, good)]
    found: dict[str, list[dict[str, Floats]]] = {}
    for done, (what, variant, rule) in enumerate(jobs):
        progress(task_name, done, len(jobs))
        found.setdefault(what, []).append(_run(variant, rule, seeds))
    progress(task_name, len(jobs), len(jobs))

    def mean(what: str, figure: str) -> Floats:
        """Of each world, over all weights."""
        return np.mean([run[figure] for run in found[what]], axis=0)

    own, random, best = (mean(what, "team") for what in ("policy", "random", "best"))
    first, mixed = mean("policy", "first"), mean("others_random", "first")
    alone = mean("no_uav_ranges", "team")
    span = float(best.mean() - random.mean())
    name = policy if isinstance(policy, str) else getattr(policy, "__name__", "a function")
    figures: dict[str, Any] = {
        "task": task_name,
        "policy": name,
        "worlds": worlds,
        "first_seed": FIRST_SEED,
        "return": float(own.mean()),
        "standard_error": float(own.std(ddof=1) / worlds**0.5),
        "interquartile_mean": interquartile_mean(own),
        "interval_95": list(bootstrap(own)),
        "error": float(mean("policy", "error").mean()),
        "random": float(random.mean()),
        "best_known": {"policy": task.best, "return": float(best.mean())},
        "share_of_span": float((own.mean() - random.mean()) / span) if span else None,
        "interaction": {
            "uav_0": float(first.mean()),
            "uav_0_others_random": float(mixed.mean()),
            "cost": float((first - mixed).mean()),
        },
        "cooperation": {
            "without_uav_ranges": float(alone.mean()),
            "worth": float((own - alone).mean()),
        },
    }
    for figure in ("messages", "bytes", "distance", "energy", "collisions"):
        figures[figure] = float(mean("policy", figure).mean())
    if len(policies) > 1:
        by_seed = np.array([run["team"].mean() for run in found["policy"]])
        figures["seeds"] = {
            "returns": by_seed.tolist(),
            "interquartile_mean": interquartile_mean(by_seed),
            "interval_95": list(bootstrap(by_seed)),
        }
    return {**figures, "returns": own.tolist()}


def interquartile_mean(values: Floats) -> float:
    """Mean of the middle half (Agarwal et al., NeurIPS 2021; ``rliable``'s ``aggregate_iqm``)."""
    return float(trim_mean(values, 0.25))


def bootstrap(values: Floats, level: float = 0.95) -> tuple[float, float]:
    """Percentile interval of the interquartile mean, of values drawn with replacement: of worlds,
    or of training seeds (``rliable``'s ``get_interval_estimates`` of one task)."""
    draws = np.random.default_rng(0).integers(0, len(values), (_RESAMPLES, len(values)))
    means = trim_mean(values[draws], 0.25, axis=1)
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
    """Per world: the team's mean return, that of uav_0, mean error (m), and what those that act
    send and spend: messages, bytes, distance (m), energy (J), steps too near each other."""
    team = first = error = torch.zeros(len(seeds), dtype=torch.float64)
    effort: Effort | None = None
    for step in rollout(task, policy, seeds):
        team = team + step.reward.double().mean(-1)
        first = first + step.reward[:, 0].double()
        error = error + step.error.double().mean(-1) / task.scenario.horizon
        if effort is None:
            effort = Effort(step.world)  # of the start the motion is not there any more
        else:
            effort.count()
    assert effort is not None
    world = effort.world
    spent = {
        "messages": world.messages_sent,
        "bytes": world.bytes_sent,
        "distance": effort.distance,
        "energy": effort.energy,
        "collisions": effort.collisions,
    }
    figures = {"team": team, "first": first, "error": error}
    figures |= {name: value[:, : task.n_agents].sum(-1) for name, value in spent.items()}
    return {name: value.double().numpy() for name, value in figures.items()}
