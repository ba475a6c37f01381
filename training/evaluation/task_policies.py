"""Policies of a task by name, and those written for one PettingZoo world."""

import importlib
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agents.tasks.rules import Policy, Seen
from agents.tasks.task import Task
from agents.weights import SUFFIX, shipped

Observations = dict[str, Any]
WorldPolicy = Callable[[Observations, Observations], Mapping[str, Any]]


def find_policies(task: Task, names: str) -> list[Policy]:
    """Each of some policies, separated by commas: a heuristic of the task, a checkpoint
    (``….safetensors``, or a shipped one's name), or somebody's own ``module:function``. ValueError
    for one that is none."""
    return [_find(task, name) for name in names.split(",")]


def _find(task: Task, name: str) -> Policy:
    if name.endswith(SUFFIX) or name in shipped():
        from agents.policies.task_policy import load_policy

        learned: Policy = load_policy(task, name)
        return learned
    module, separator, attribute = name.partition(":")
    if not separator:
        return task.policy(name)
    try:
        policy: Policy = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, SyntaxError, TypeError, ValueError) as error:
        raise ValueError(f"--policy {name}: {error}") from error
    return _guarded(name, policy)


def _guarded(name: str, policy: Policy) -> Policy:
    """Somebody's own policy, whose errors are one line that says where; the traceback is their
    cause."""

    def guarded(seen: Seen) -> Tensor:
        try:
            action = policy(seen)
        except Exception as error:  # somebody's own code may raise anything
            last = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{Path(last.filename).name}, line {last.lineno}"
            what = f"{type(error).__name__}: {error}"
            raise ValueError(f"--policy {name}: {what} ({where})") from error
        if not isinstance(action, Tensor):
            raise ValueError(f"--policy {name}: returns {type(action).__name__}, not a tensor")
        return action

    return guarded


def from_pettingzoo(make: Callable[[], WorldPolicy]) -> Policy:
    """A policy for many worlds from one for a PettingZoo world, as ``score`` takes it.

    ``make`` is called once for each world, at an episode's first step; what it makes takes the
    agents' observations and infos (with their ``action_mask``, where actions are choices) by name,
    and returns their actions by name.
    """
    acting: list[WorldPolicy] = []

    def policy(seen: Seen) -> Tensor:
        task = seen.task
        agents = task.scenario.agents[: task.n_agents]
        if bool((seen.memory.step == 0).all()):
            acting[:] = [make() for _ in range(len(seen.observation))]
        rows = []
        for b, act in enumerate(acting):
            observations = dict(zip(agents, seen.observation[b].numpy(), strict=True))
            infos: Observations = {agent: {} for agent in agents}
            if seen.mask is not None:
                masks = seen.mask[b].numpy().astype(np.int8)
                infos = {a: {"action_mask": m} for a, m in zip(agents, masks, strict=True)}
            actions = act(observations, infos)
            missing = [agent for agent in agents if agent not in actions]
            if missing:
                raise ValueError(f"{task.name}: no action for {missing[0]}")
            rows.append(np.stack([np.asarray(actions[agent]) for agent in agents]))
        return torch.from_numpy(np.stack(rows))

    return policy
