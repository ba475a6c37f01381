"""Observations: which leaves a scenario's UAVs see, as one batched container and as spaces."""

from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

import gymnasium as gym
import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from coloc_env.motion import Arena
from coloc_env.scenario import Scenario
from coloc_env.sensors.base import MASK, Leaf

if TYPE_CHECKING:
    from tensordict import TensorDict


_ACTION = "m, m/s, log m"
_PRIOR = "m, m/s, attitude; their σ"
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Observation:
    """What N UAVs of B worlds observe at one step: float32 leaves [B, N, F] by name.

    A plain mapping rather than a tensorclass: new sensors bring new leaves, and building one costs
    nothing in the step.
    """

    leaves: Mapping[str, Float32[Tensor, "B N F"]]

    def __getitem__(self, name: str) -> Float32[Tensor, "B N F"]:
        return self.leaves[name]

    def __contains__(self, name: str) -> bool:
        return name in self.leaves

    @property
    def batch_size(self) -> torch.Size:
        """(B, N)."""
        return next(iter(self.leaves.values())).shape[:2]

    @property
    def device(self) -> torch.device:
        return next(iter(self.leaves.values())).device

    def once(self, key: Hashable, read: Callable[[], _T]) -> _T:
        """What ``read`` makes of the leaves; the first time only, where it is ``kept``."""
        return read()

    def kept(self) -> "Observation":
        """The same leaves, of which each thing is read once: for a step of a localizer, in which
        nobody writes to them."""
        return _Kept(self.leaves)

    def to_tensordict(self) -> "TensorDict":
        """The same leaves with batch size [B, N]."""
        from tensordict import TensorDict  # takes a second, which PettingZoo's users need not wait

        return TensorDict(dict(self.leaves), batch_size=self.batch_size, device=self.device)


@dataclass(frozen=True, slots=True)
class _Kept(Observation):
    """With what has been read of it."""

    found: dict[Hashable, Any] = field(default_factory=dict)

    def once(self, key: Hashable, read: Callable[[], _T]) -> _T:
        if key not in self.found:
            self.found[key] = read()
        return self.found[key]

    def kept(self) -> "_Kept":
        return self


def prior_width(dim: int) -> int:
    """Mean position, velocity and attitude, then standard deviations (per axis for position)."""
    return 3 * dim + (4 if dim == 3 else 1) + 2


def prior_action(observation: Observation, dim: int) -> Float32[Tensor, "B N A"]:
    """What each UAV knows of its start, as an action."""
    prior = observation["prior"]
    return torch.cat((prior[..., : 2 * dim], prior[..., -2 - dim : -2].clamp_min(1e-6).log()), -1)


def static_leaves(scenario: Scenario) -> dict[str, Leaf]:
    """Leaves that stay the same over an episode: the prior and the maps."""
    leaves = {"prior": Leaf(prior_width(scenario.arena.dim), unit=_PRIOR, frame="world")}
    for sensor in scenario.sensors:
        leaves |= sensor.map_leaves(scenario.layout)
    return leaves


def sensed_leaves(scenario: Scenario) -> dict[str, Leaf]:
    """Leaves sensed at each step, messages aside."""
    slots = scenario.layout.slots
    leaves: dict[str, Leaf] = {}
    for sensor in scenario.sensors:
        added = sensor.leaves(scenario.layout)
        twice = leaves.keys() & added.keys()
        if twice:
            raise ValueError(f"{scenario.name}: two sensors deliver the leaf {sorted(twice)[0]!r}")
        leaves |= added
    leaves["links"] = Leaf(slots, *MASK)
    if not scenario.network.dense(scenario.arena.n_uavs):
        leaves["neighbours"] = Leaf(slots, 0.0, float(scenario.arena.n_uavs - 1))
    return leaves


def message_leaves(scenario: Scenario) -> dict[str, Leaf]:
    """What other UAVs' messages bring: per slot the sender's action, and whether one came."""
    slots = scenario.layout.slots
    return {
        "messages": Leaf(slots * action_width(scenario), unit=_ACTION, frame="world"),
        "message_mask": Leaf(slots, *MASK),
    }


def action_width(scenario: Scenario) -> int:
    """Position, velocity and log standard deviation of the position, per axis."""
    return 3 * scenario.arena.dim


def all_leaves(scenario: Scenario) -> dict[str, Leaf]:
    """Every leaf of an observation, in the order of the spaces."""
    return sensed_leaves(scenario) | message_leaves(scenario) | static_leaves(scenario)


def observation_space(leaves: Mapping[str, Leaf]) -> gym.spaces.Dict:
    """One UAV's observation: a Dict of 1-D float32 Boxes."""
    return gym.spaces.Dict(
        {
            name: gym.spaces.Box(leaf.low, leaf.high, (leaf.width,), np.float32)
            for name, leaf in leaves.items()
        }
    )


def action_bounds(arena: Arena) -> tuple[list[float], list[float]]:
    """Bounds of the flat action: twice the arena's extent, log-std within ±10, and ±50 m/s, or so
    much as crosses the arena's longest side in 50 s.

    They describe where sensible estimates lie (and samples are drawn from); a finite estimate
    beyond them is scored, not refused.
    """
    low, high = [], []
    for a, b in zip(arena.low, arena.high, strict=True):
        low.append(a - 0.5 * (b - a))
        high.append(b + 0.5 * (b - a))
    dim = arena.dim
    fast = max(50.0, *((b - a) / 50.0 for a, b in zip(arena.low, arena.high, strict=True)))
    return low + [-fast] * dim + [-10.0] * dim, high + [fast] * dim + [10.0] * dim


def state_bounds(scenario: Scenario) -> tuple[list[float], list[float]]:
    """Bounds of the privileged truth: per UAV position, velocity, attitude, alive, scored."""
    arena = scenario.arena
    attitude = [1.0] * 4 if arena.dim == 3 else [float(np.pi) + 1e-6]
    margin = [0.1 * (b - a) + 1.0 for a, b in zip(arena.low, arena.high, strict=True)]
    low = [a - m for a, m in zip(arena.low, margin, strict=True)]
    high = [b + m for b, m in zip(arena.high, margin, strict=True)]
    low += [-500.0] * arena.dim + [-x for x in attitude] + [0.0, 0.0]
    high += [500.0] * arena.dim + attitude + [1.0, 1.0]
    return low * arena.n_uavs, high * arena.n_uavs


def box(bounds: tuple[list[float], list[float]]) -> gym.spaces.Box:
    """A flat float32 Box of lowest and highest numbers."""
    low, high = (np.array(x, np.float32) for x in bounds)
    return gym.spaces.Box(low, high, dtype=np.float32)


def flat_box(leaves: Mapping[str, Leaf]) -> gym.spaces.Box:
    """The Box of leaves side by side."""
    low = [leaf.low for leaf in leaves.values() for _ in range(leaf.width)]
    high = [leaf.high for leaf in leaves.values() for _ in range(leaf.width)]
    return box((low, high))


def stack(observations: Iterable[Mapping[str, np.ndarray]]) -> Observation:
    """Observations of the agents of one PettingZoo world as an ``Observation`` with B = 1."""
    agents = list(observations)
    return Observation(
        {
            name: torch.from_numpy(np.stack([agent[name] for agent in agents])).unsqueeze(0)
            for name in agents[0]
        }
    )
