"""What an action is."""

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float32
from torch import Tensor

from coloc_env.commands import Commands
from coloc_env.observation import Observation, state_bounds
from coloc_env.scenario import Believed, Scenario
from coloc_env.sensors.base import Leaf
from coloc_env.world import World

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
