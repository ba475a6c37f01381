"""Action modes: what an action means, what an agent observes for it, and the error for a wrong one.

The world scores estimates, whatever the mode: a mode turns actions into them. Localizers act in
``estimate``; learners in ``displacement`` (``coloc_env.envs.displacement``) or with corrections
on a localizer's estimates (``agents.wrappers.correction.with_base``).
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from coloc_env.commands import SILENT, Commands
from coloc_env.observation import Observation, action_bounds, all_leaves, box, state_bounds
from coloc_env.scenario import Believed, Scenario
from coloc_env.sensors import AnchorRanging
from coloc_env.sensors.base import Leaf
from coloc_env.world import Step, World

Leaves = dict[str, Float32[Tensor, "B N F"]]
MAX_STATE_ERROR = 100.0  # m: larger errors are cut in the privileged state, whose bounds are finite


class ActionMode(ABC):
    """What an action is, to a team with some beliefs: pure functions of a memory, batch (B, N).

    A memory is a tensorclass of batch (B, N) that holds all there is from step to step (None if
    there is nothing). In each step first ``observe``, then ``estimate`` is called. ``leaves`` are
    what the mode adds to each UAV's observation, ``features`` those that a policy should read,
    ``meaning`` the words for an action in error messages. ``choices``: actions are one of so many
    (None: numbers within ``bounds``). ``whole``: its leaves are all that agents see, with their
    ``action_mask`` where actions are choices: one flat vector ``observation`` where it is ``flat``,
    else a Dict.
    ``rewards``: rewards are its own, of what is estimated after the step.
    """

    name: str
    choices: int | None = None
    whole: bool = False
    flat: bool = True
    meaning: str
    rewards: bool = False
    features: tuple[str, ...] = ()

    def __init__(self, believed: Believed) -> None:
        self.believed = believed
        self.dim = believed.arena.dim

    @property
    def n_agents(self) -> int:
        """The first so many UAVs act; the others are part of the world."""
        return self.believed.arena.n_uavs

    @property
    def bounds(self) -> tuple[list[float], list[float]]:
        """Lowest and highest numbers of one UAV's action: ±1 for each axis."""
        return [-1.0] * self.dim, [1.0] * self.dim

    @cached_property
    def width(self) -> int:
        """How many numbers one UAV's action has."""
        return 1 if self.choices else len(self.bounds[0])

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Shape of one UAV's action."""
        return () if self.choices else (self.width,)

    @property
    def settings(self) -> dict[str, Any]:
        """What describes it, beside the beliefs."""
        return {"name": self.name}

    @property
    def leaves(self) -> dict[str, Leaf]:
        """What it adds to an observation."""
        return {}

    def reset(self, observation: Observation) -> Any:
        """The memory before the first observation is used."""
        return None

    def observe(self, memory: Any, observation: Observation) -> tuple[Any, Leaves]:
        """Use an observation: the memory with it, and the leaves that it adds."""
        return memory, {}

    @abstractmethod
    def estimate(
        self, memory: Any, action: Float32[Tensor, "B N a"]
    ) -> tuple[Any, Float32[Tensor, "B N A"]]:
        """The memory after an action, and the estimate that it stands for: position (m), velocity
        (m/s) and log standard deviation of the position (m), each per axis of the world frame."""

    def commands(self, memory: Any, action: Float32[Tensor, "B n a"]) -> Commands:
        """What an action commands the world to do in the step to come."""
        return Commands()

    def reward(self, memory: Any, world: World) -> tuple[Any, Float32[Tensor, "B n"]]:
        """The reward of the step that led here, given the memory with this step's observation, and
        the memory with what rewards are counted by."""
        raise NotImplementedError

    def reference(self, memory: Any) -> Float32[Tensor, "B N d"] | None:
        """The position (m) that actions are relative to; None where they are not."""
        return None

    def state(self, memory: Any, world: World) -> Float32[Tensor, "B S"]:
        """What a critic may know: the truth, and the error in m of what actions are relative to,
        if they are."""
        truth, reference = world.state(), self.reference(memory)
        if reference is None:
            return truth
        error = (reference - world.now.target).clamp(-MAX_STATE_ERROR, MAX_STATE_ERROR)
        return torch.cat((truth, error.flatten(-2)), -1)

    def state_bounds(self, scenario: Scenario) -> tuple[list[float], list[float]]:
        """Bounds of the flat state."""
        low, high = state_bounds(scenario)
        if type(self).reference is not ActionMode.reference:
            more = scenario.arena.n_uavs * self.dim
            low, high = low + [-MAX_STATE_ERROR] * more, high + [MAX_STATE_ERROR] * more
        return low, high


class Estimates(ActionMode):
    """The estimate itself, as localizers give it (values beyond ``bounds`` are scored as well).

    Where motion is steered, the command for the step to come follows (m/s or m/s², world frame);
    where links are decided upon, the call in that step, to the nearest whole number: −1 for none, a
    UAV's number or N + m for anchor m where they are chosen, 0 to speak where they are broadcast.
    """

    name = "estimate"
    meaning = "[position, velocity, log-std]"

    def __init__(self, believed: Believed) -> None:
        super().__init__(believed)
        self.largest, self.calls = believed.largest_command, believed.links != "all"
        self.last = 0  # call
        if believed.links == "chosen":
            anchors = believed.sensor(AnchorRanging)
            self.last = believed.arena.n_uavs + (len(anchors.anchors) if anchors else 0) - 1
        command = ", command" if self.largest else ""
        self.meaning = f"[position, velocity, log-std{command}{', call' if self.calls else ''}]"

    @property
    def bounds(self) -> tuple[list[float], list[float]]:
        low, high = action_bounds(self.believed.arena)
        more = [self.largest] * self.dim if self.largest else []
        calls = [float(self.last)] if self.calls else []
        return low + [-x for x in more] + [-1.0 for _ in calls], high + more + calls

    def estimate(
        self, memory: None, action: Float32[Tensor, "B N A"]
    ) -> tuple[None, Float32[Tensor, "B N A"]]:
        return None, action[..., : 3 * self.dim] if self.largest or self.calls else action

    def commands(self, memory: None, action: Float32[Tensor, "B N A"]) -> Commands:
        d = self.dim
        calls = action[..., -1].round().clamp(SILENT, self.last).long() if self.calls else None
        return Commands(action[..., 3 * d : 4 * d] if self.largest else None, calls)


class ModeRunner:
    """An action mode at work in the worlds of one environment: it keeps their memory.

    The leaves that it gives are copies, which agents may edit.
    """

    def __init__(self, mode: ActionMode, world: World) -> None:
        self.mode, self.world = mode, world
        self.width = mode.width
        self._adds_nothing = not mode.leaves and type(mode).reset is ActionMode.reset
        self._started = self._ahead = False
        self._commands = Commands()
        self._memory: Any = None
        self._leaves: Leaves = {}

    def reset(self, rows: Bool[Tensor, "B"] | None = None) -> Leaves:
        """Restart the rows that have been reset (None: all) and return every row's leaves at the
        current step."""
        if self._adds_nothing:
            return {}
        observation = self.world.observation()
        fresh, leaves = self.mode.observe(self.mode.reset(observation), observation)
        if rows is not None and self._started and not bool(rows.all()):
            chosen = rows[:, None].expand(observation.batch_size)
            fresh = None if fresh is None else fresh.where(chosen, self._memory)
            leaves = {
                name: torch.where(rows[:, None, None], leaf, self._leaves[name])
                for name, leaf in leaves.items()
            }
        self._memory, self._leaves, self._started, self._ahead = fresh, leaves, True, False
        return self._copies()

    def observe(self) -> Leaves:
        """The leaves at the step that the worlds have moved to."""
        if self._adds_nothing:
            return {}
        if self._ahead:
            self._ahead = False
        else:
            self._memory, self._leaves = self.mode.observe(self._memory, self.world.observation())
        return self._copies()

    def _copies(self) -> Leaves:
        return {name: leaf.clone() for name, leaf in self._leaves.items()}

    def estimate(self, action: Float32[Tensor, "B n a"]) -> Float32[Tensor, "B N A"]:
        """The estimates that actions stand for; what they command waits for ``step``."""
        self._memory, estimates = self.mode.estimate(self._memory, action)
        self._commands = self.mode.commands(self._memory, action)
        return estimates

    def step(self, estimates: Float32[Tensor, "B N A"]) -> Step:
        """Move the worlds on, estimates scored and commands obeyed; rewards are the mode's."""
        step = self.world.step(estimates, self._commands)
        if not self.mode.rewards:
            return step
        self.observe()
        self._ahead = True
        self._memory, reward = self.mode.reward(self._memory, self.world)
        return step._replace(reward=reward)

    @property
    def memory(self) -> Any:
        """The mode's memory at the step last observed."""
        return self._memory

    def state(self) -> Float32[Tensor, "B S"]:
        """What a critic may know."""
        return self.mode.state(self._memory, self.world)


def action_space(mode: ActionMode) -> gym.spaces.Space[Any]:
    """One UAV's actions."""
    if mode.choices is not None:
        return gym.spaces.Discrete(mode.choices)
    return box(mode.bounds)


def make_mode(scenario: Scenario, action: str | ActionMode) -> ActionMode:
    """A mode by name (``estimate``, ``displacement``), or the one given. ValueError for another
    name, or for a mode that was made for another scenario."""
    if isinstance(action, ActionMode):
        if action.believed is not scenario.believed:
            raise ValueError(f"{scenario.name}: the action mode was made for another scenario")
        return action
    if action == Estimates.name:
        return Estimates(scenario.believed)
    if action == "displacement":
        from coloc_env.envs.displacement import (
            Displacement,  # tensordict takes a second that localizers need not wait
        )

        return Displacement(scenario.believed)
    raise ValueError(f"action={action!r} is not allowed: estimate, displacement, or an ActionMode")


def observed_leaves(scenario: Scenario, mode: ActionMode) -> dict[str, Leaf]:
    """Every leaf of an observation in this mode, in the order of the spaces."""
    return mode.leaves if mode.whole else all_leaves(scenario) | mode.leaves


def chosen_leaves(
    scenario: Scenario, mode: ActionMode, wanted: Sequence[str] | None
) -> dict[str, Leaf]:
    """The leaves of a flat observation: those wanted, else those that the mode recommends, else
    all. ValueError for one that does not exist, and where UAVs can fail: rows of one world then do
    not end together."""
    known = observed_leaves(scenario, mode)
    own = [name for name in known if name != "action_mask"]
    names = tuple(wanted or (own if mode.whole else mode.features or known))
    for name in names:
        if name not in known:
            raise ValueError(f"there is no leaf {name!r}; known: {', '.join(known)}")
    if scenario.failure_rate or scenario.failures:
        raise ValueError(f"{scenario.name}: UAVs that fail do not fit rows of one UAV each")
    return {name: known[name] for name in names}


# ------------------------------------------------------------------ checks of actions


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
