"""The seam every sensor sits on: one file per modality, no change to World, faces or localizers."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64, Shaped
from torch import Tensor

from coloc_env import noise
from coloc_env.motion import Arena, Kinematics
from coloc_env.series import Series

MASK = (0.0, 1.0)
_FARTHEST = 1e4  # m: of distances that a sensor can measure


@dataclass(frozen=True)
class Leaf:
    """One 1-D float32 entry of a UAV's observation: its width, the bounds of its Box, and, for
    whoever reads it, the unit of its numbers and the frame that they are in."""

    width: int
    low: float = -float("inf")
    high: float = float("inf")
    unit: str = ""
    frame: str = ""


@dataclass(frozen=True)
class Layout:
    """What fixes the widths of leaves: the arena and how many neighbour slots a UAV has."""

    arena: Arena
    slots: int


@dataclass(frozen=True)
class Window:
    """What sensors see of R worlds over K steps: truth (float64), who reaches whom, and keys.

    ``motion`` and ``before`` are the true kinematics at each step and one step earlier (the same at
    step 0). ``rows`` are the rows' noise keys, ``keys`` those of (row, step). Slot ``s`` of UAV
    ``i`` holds UAV ``neighbours[…, i, s]``; ``reach``: whether its radio signal arrives,
    message loss aside. ``to_anchors``: whose exchanges with anchors at given places (m) succeed,
    where UAVs choose them (None: everybody's). The last ``targets`` UAVs range no anchors.
    """

    layout: Layout
    motion: Kinematics
    before: Kinematics
    rows: Int64[Tensor, "R"]
    keys: Int64[Tensor, "R K"]
    steps: Int64[Tensor, "R K"]
    alive: Bool[Tensor, "R K N"]
    neighbours: Int64[Tensor, "#R #K N S"]
    reach: Bool[Tensor, "R K N S"]
    past: dict[int, tuple[Kinematics, Int64[Tensor, "R K"]]] = field(default_factory=dict)
    to_anchors: Callable[[Float64[Tensor, "R A d"]], Bool[Tensor, "R N A"]] | None = None
    targets: int = 0

    @property
    def is_target(self) -> Bool[Tensor, "N"]:
        """Which UAVs are targets."""
        n = self.layout.arena.n_uavs
        return torch.arange(n, device=self.keys.device) >= n - self.targets

    def delayed(self, delay: int) -> tuple[Kinematics, Int64[Tensor, "R K"]]:
        """Kinematics and noise keys ``delay`` steps earlier: what a delayed sensor delivers now."""
        return self.past[delay] if delay else (self.motion, self.keys)

    def uav_keys(self, keys: Int64[Tensor, "R K"], stream: int) -> Int64[Tensor, "R K N"]:
        """One key per UAV, for a sensor's own events."""
        index = torch.arange(self.layout.arena.n_uavs, device=keys.device)
        return noise.fold(keys.unsqueeze(-1), index + stream)


def usable(
    z: Float[Tensor, "*s m k"], mask: Bool[Tensor, "*s m"], ranges: bool = False
) -> tuple[Float[Tensor, "*s m k"], Bool[Tensor, "*s m"]]:
    """Measurements and their mask, false (and the numbers 0) where a number is not finite or, with
    ``ranges``, the first is no distance that a sensor can give. Whoever computes with a
    measurement reads its leaf through this."""
    mask = mask & z.isfinite().all(-1)
    if ranges:
        mask = mask & (z[..., 0] > 0) & (z[..., 0] <= _FARTHEST)
    return z.masked_fill(~mask.unsqueeze(-1), 0.0), mask


class Sensor(ABC):
    """Base of all sensors: frozen dataclasses whose fields are the sensor's true settings.

    The same class describes what a team *believes* of the sensor (``scenario.believed.sensors``),
    so a localizer finds the noise model it should assume under the sensor's type.
    """

    informs: ClassVar[bool] = True
    """Whether it is a measurement (the frame that estimates are stated in is none)."""

    between_uavs: ClassVar[bool] = False
    """Whether it ties UAVs together (as a range between two does, a range to an anchor not)."""

    may_be_blind: ClassVar[bool] = True
    """Whether it measures nothing at steps at which the truth is not known (what is recorded, and
    what drives a motion model, is there at every step)."""

    @property
    def delay(self) -> int:
        """Steps between sensing and delivery."""
        return 0

    @property
    def fix_slots(self) -> int:
        """How many of its measurements, with an attitude, imply the UAV's position."""
        return 0

    def fixes(
        self, leaves: Mapping[str, Float32[Tensor, "B N F"]], attitude: Float32[Tensor, "B N a"]
    ) -> tuple[Float32[Tensor, "B N m d"], Bool[Tensor, "B N m"]]:
        """Those positions (m, world frame) and which were measured."""
        raise NotImplementedError

    def turn_rate(
        self, leaves: Mapping[str, Float32[Tensor, "B N F"]]
    ) -> Float32[Tensor, "B N t"] | None:
        """Turn over the step that ends now (rad/s, body frame), if that is what it measures."""
        return None

    @abstractmethod
    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        """Names and shapes of what the sensor adds to each UAV's observation at every step."""

    def map_leaves(self, layout: Layout) -> dict[str, Leaf]:
        """Leaves that are constant over an episode (maps)."""
        return {}

    def place(self, keys: Int64[Tensor, "R"], layout: Layout) -> dict[str, Tensor]:
        """What R worlds draw at reset: landmark positions, biases. Leading size R."""
        return {}

    def map_values(self, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        """Values [R, F] of ``map_leaves`` from what was placed."""
        return {}

    @abstractmethod
    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        """Leaves [R, K, N, F] float32; masked entries are 0 and their mask leaf is 0 there."""


@dataclass(frozen=True, eq=False)
class RecordedSensor(Sensor):
    """A sensor whose samples come from a recording: step k delivers ``series[leaf][k]``.

    ``sensor`` describes the leaves; each series is float32 [T, N, F]; maps are [F]. ``dropped``: by
    the recording's stream, how many measurements were left out, since no sensor can have given
    them.
    """

    may_be_blind = False

    sensor: Sensor
    series: dict[str, Series]
    maps: dict[str, Tensor] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        return self.sensor.leaves(layout)

    def map_leaves(self, layout: Layout) -> dict[str, Leaf]:
        return self.sensor.map_leaves(layout)

    def place(self, keys: Int64[Tensor, "R"], layout: Layout) -> dict[str, Tensor]:
        return {
            name: value.to(keys.device).expand(len(keys), -1) for name, value in self.maps.items()
        }

    def map_values(self, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        return placed

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        alive = window.alive.unsqueeze(-1)
        return {name: values.at(window.steps) * alive for name, values in self.series.items()}


def require(condition: bool, owner: Any, name: str, allowed: str) -> None:
    """Raise a ValueError that names a wrong setting and what is allowed."""
    if not condition:
        kind = type(owner).__name__ if not isinstance(owner, str) else owner
        value = getattr(owner, name, None)
        raise ValueError(f"{kind}: {name}={value!r} is not allowed: {allowed}")


def in_slots(
    values: Shaped[Tensor, "R K N *f"], neighbours: Int64[Tensor, "#R #K N S"]
) -> Shaped[Tensor, "R K #N S *f"]:
    """What belongs to the UAV in each neighbour slot; one row for all where slot j is UAV j."""
    if neighbours.shape[-1] == values.shape[2]:
        return values.unsqueeze(2)
    rows = torch.arange(values.shape[0], device=values.device)[:, None, None, None]
    steps = torch.arange(values.shape[1], device=values.device)[:, None, None]
    return values[rows, steps, neighbours]


def squared_norm(x: Float64[Tensor, "*s d"]) -> Float64[Tensor, "*s"]:
    """Sum of squares over 2 or 3 components in a fixed order, whatever the batch's shape."""
    total = x[..., 0] * x[..., 0] + x[..., 1] * x[..., 1]
    return total + x[..., 2] * x[..., 2] if x.shape[-1] == 3 else total
