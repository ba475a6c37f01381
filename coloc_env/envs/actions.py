"""Action modes: what an action means, and what an agent observes for it.

The world scores estimates, whatever the mode: a mode turns actions into them. Localizers act in
``estimate``; learners in ``displacement`` (``coloc_env.envs.displacement``) or with corrections
on a localizer's estimates (``agents.wrappers.correction.with_base``).
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
from jaxtyping import Float32
from torch import Tensor

from coloc_env.commands import SILENT, Commands
from coloc_env.envs.action_mode import ActionMode
from coloc_env.observation import action_bounds, all_leaves, box
from coloc_env.scenario import Believed, Scenario
from coloc_env.sensors import AnchorRanging
from coloc_env.sensors.base import Leaf


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
