"""Actions checked where they enter: one line names the agent and what is needed."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from coloc_env.envs.action_mode import ActionMode
from coloc_env.scenario import Scenario


def checked_tensor(
    scenario: Scenario, mode: ActionMode, actions: Tensor, worlds: int
) -> Float32[Tensor, "B N a"]:
    """Actions of several worlds as float32. ValueError, in one line that names UAV, world and what
    is needed, for another shape, complex numbers, and NaN or infinity."""
    shape: tuple[int, ...] = (worlds, mode.n_agents)
    if mode.choices is None:
        shape = (*shape, mode.width)
    if tuple(actions.shape) != shape:
        raise ValueError(
            f"{scenario.name}: actions of shape {tuple(actions.shape)} do not fit: {shape} "
            f"(worlds, UAVs, {mode.meaning}) is needed with action={mode.name}"
        )
    if actions.is_complex():
        raise ValueError(f"{scenario.name}: complex actions do not fit; {_needed(mode)}")
    actions = actions.to(torch.float32)
    finite = actions.isfinite()
    if not bool(finite.all()):
        row, uav = (~finite).nonzero()[0, :2].tolist()
        raise ValueError(
            f"{scenario.name}: the action of uav_{uav} in world {row} holds NaN or infinity; "
            f"{_needed(mode)}"
        )
    if mode.choices is not None:
        known = (actions >= 0) & (actions < mode.choices) & (actions == actions.round())
        if not bool(known.all()):
            row, uav = (~known).nonzero()[0].tolist()
            raise ValueError(
                f"{scenario.name}: the action of uav_{uav} in world {row} is none of the choices; "
                f"{_needed(mode)}"
            )
    return actions


def checked_arrays(
    scenario: Scenario, mode: ActionMode, actions: Mapping[str, Any], agents: Sequence[str]
) -> Float32[np.ndarray, "n a"]:
    """The agents' actions, one a row. ValueError, in one line that names the agent and what is
    needed, for one that is not numeric, complex, of another shape, or holds NaN or infinity."""
    rows = _array([actions[agent] for agent in agents])
    if rows is not None and rows.shape == (len(agents), *mode.shape):
        values = rows.astype(np.float32, copy=False)
        if np.count_nonzero(np.isfinite(values)) == values.size and _chosen(mode, values):
            return values
    return np.stack([_checked_array(scenario, mode, actions[agent], agent) for agent in agents])


def _checked_array(
    scenario: Scenario, mode: ActionMode, action: Any, agent: str
) -> Float32[np.ndarray, "a"]:
    values = _array(action)
    if values is None:
        wrong = "is not made of real numbers"
    elif values.shape != mode.shape:
        wrong = f"has shape {values.shape}"
    elif not np.isfinite(values.astype(np.float32)).all():
        wrong = "holds NaN or infinity"
    elif not _chosen(mode, values):
        wrong = f"is {values}, none of the choices"
    else:
        return values.astype(np.float32)
    raise ValueError(f"{scenario.name}: the action of {agent} {wrong}; {_needed(mode)}")


def _chosen(mode: ActionMode, values: np.ndarray) -> bool:
    """Whether actions are among the choices, where there are choices."""
    if mode.choices is None:
        return True
    return bool(((values >= 0) & (values < mode.choices) & (values == np.round(values))).all())


def _array(numbers: Any) -> np.ndarray | None:
    """An array of real numbers; None for anything else."""
    try:
        array = np.asarray(numbers)
    except (TypeError, ValueError, RuntimeError):
        return None
    return array if array.dtype.kind in "fiub" else None


def _needed(mode: ActionMode) -> str:
    if mode.choices is not None:
        last = mode.choices - 1
        return f"0 to {last} is needed with action={mode.name}: {mode.meaning}"
    return f"({mode.width},) finite numbers are needed with action={mode.name}: {mode.meaning}"
