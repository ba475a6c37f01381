"""What a dataset holds: its runs, in which parts they are written, and its columns."""

import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from coloc_env.observation import action_width, message_leaves, sensed_leaves, static_leaves
from coloc_env.options import set_words, typed
from coloc_env.scenario import Scenario
from coloc_env.sensors import Leaf

PART_BYTES = 64_000_000  # of a part, about
_MOST_RUNS = 64  # in a part, which are run side by side
_ATTITUDE = {3: Leaf(4, unit="quaternion wxyz", frame="body to world"), 2: Leaf(1, unit="rad")}


@dataclass(frozen=True)
class Column:
    """Numbers of one kind: of each run, step and UAV, or (``world``) of each run and UAV.

    ``leaf``: how many they are, their unit and frame. ``name``: its keys in a TensorDict, which a
    table joins by dots.
    """

    name: tuple[str, ...]
    leaf: Leaf
    dtype: torch.dtype = torch.float32
    world: bool = False

    @property
    def title(self) -> str:
        return ".".join(self.name)


@dataclass(frozen=True)
class Plan:
    """``runs`` of a scenario seeded ``seed``, ``seed`` + 1, …, their first ``steps`` steps;
    ``agent``: who estimates (None: nobody, and there are no actions, rewards or messages)."""

    scenario: Scenario
    runs: int
    seed: int = 0
    steps: int = 0
    agent: str | None = None

    def __post_init__(self) -> None:
        horizon = self.scenario.horizon
        if not 1 <= self.runs <= 10**7:
            raise ValueError(f"--runs {self.runs} is not allowed: 1 to 10000000")
        if not 1 <= self.steps <= horizon:
            name = self.scenario.name
            raise ValueError(f"--steps {self.steps} is not allowed: 1 to {horizon} for {name}")
        if (links := self.scenario.network.links) != "all":
            raise ValueError(f"links={links} is not allowed: nobody chooses them in a dataset")

    @cached_property
    def columns(self) -> tuple[Column, ...]:
        """All there is beside ``seed``, ``step`` and ``uav``."""
        dim, own = self.scenario.arena.dim, sensed_leaves(self.scenario)
        place, speed = Leaf(dim, unit="m", frame="world"), Leaf(dim, unit="m/s", frame="world")
        truth = {"position": place, "velocity": speed, "attitude": _ATTITUDE[dim]}
        flag = Leaf(1, 0.0, 1.0)
        found = [Column(("truth", name), leaf, torch.float64) for name, leaf in truth.items()]
        found += [Column((name,), flag, torch.bool) for name in ("alive", "scored")]
        if self.scenario.motion.steered:
            slow = self.scenario.overrides.get("control", "velocity") == "velocity"
            command = Leaf(dim, unit="m/s" if slow else "m/s²", frame="world")
            found.append(Column(("command",), command))
        if self.agent is not None:
            own = own | message_leaves(self.scenario)
            unit = "position m, velocity m/s, log of the standard deviation in m"
            found.append(Column(("action",), Leaf(action_width(self.scenario), unit=unit)))
            found.append(Column(("reward",), Leaf(1)))
        found += [Column(("observation", name), leaf) for name, leaf in own.items()]
        static = static_leaves(self.scenario)
        return (*found, *(Column((name,), leaf, world=True) for name, leaf in static.items()))

    @property
    def runs_in_part(self) -> int:
        """As many as fit into about 64 MB."""
        of_step = sum(c.leaf.width * c.dtype.itemsize for c in self.columns if not c.world)
        of_run = of_step * self.steps * self.scenario.arena.n_uavs
        return max(1, min(self.runs, _MOST_RUNS, PART_BYTES // of_run))

    @property
    def count(self) -> int:
        """How many parts there are."""
        return -(-self.runs // self.runs_in_part)

    def parts(self) -> Iterator[tuple[str, Tensor]]:
        """Names and seeds of all parts."""
        every = torch.arange(self.seed, self.seed + self.runs)
        for i, seeds in enumerate(every.split(self.runs_in_part)):
            yield f"part-{i:05d}", seeds

    def facts(self) -> dict[str, Any]:
        """What another plan must have in common to go on with the dataset, as JSON holds it."""
        chosen = {name: typed(value) for name, value in self.scenario.overrides.items()}
        facts = {"scenario": self.scenario.name, "overrides": chosen, "seed": self.seed}
        return facts | {"runs": self.runs, "steps": self.steps, "agent": self.agent}

    def command(self, out: str) -> str:
        """The command that writes it, as a shell reads it."""
        words = ["coloc", "dataset", self.scenario.name]
        words += ["--runs", str(self.runs), "--seed", str(self.seed)]
        if self.steps != self.scenario.horizon:
            words += ["--steps", str(self.steps)]
        if self.agent is not None:
            words += ["--agent", self.agent]
        words += set_words(self.scenario.overrides)
        return shlex.join([*words, "--out", out])
