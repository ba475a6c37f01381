"""Received signal strength: of access points at known places, and of other UAVs."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry.walls import crossed
from coloc_env.motion import Box
from coloc_env.options import Group, PositiveCount, Quantity, Share
from coloc_env.sensors.base import (
    MASK,
    Layout,
    Leaf,
    Sensor,
    Window,
    in_slots,
    require,
    squared_norm,
)

_NEAR = 0.01  # m²: nearer than 0.1 m the strength grows no more
Decibels = Annotated[float, Quantity("dB", 0.0)]
Power = Annotated[float, Quantity("dBm")]
Exponent = Annotated[float, Quantity("", above=0.0)]


@dataclass(frozen=True)
class PathLoss:
    """P₀ − 10 n log₁₀ d + N(0, ``std``²) dBm at a distance of d m, less ``wall_loss`` dB for each
    of the ``walls`` between (log-distance path loss with partition losses: Rappaport, "Wireless
    Communications", 2002, sections 4.9 to 4.11). ``power`` P₀: at 1 m; ``exponent`` n."""

    std: float = 4.0
    power: float = -40.0
    exponent: float = 2.2
    walls: tuple[Box, ...] = ()
    wall_loss: float = 5.0

    def __post_init__(self) -> None:
        require(0 <= self.std < math.inf, self, "std", "a standard deviation in dB ≥ 0")
        require(0 < self.exponent < math.inf, self, "exponent", "a number > 0")
        require(0 <= self.wall_loss < math.inf, self, "wall_loss", "a loss in dB ≥ 0")

    @property
    def slope(self) -> float:
        """10 n / ln 10: of the strength (dB) by −ln d."""
        return 10 * self.exponent / math.log(10)

    def expected(
        self, own: Float[Tensor, "*#s 1 d"], other: Float[Tensor, "*#s A d"]
    ) -> tuple[Float[Tensor, "*s A"], Float[Tensor, "*s A d"]]:
        """Strengths (dBm) by the places of both ends (m), and their derivatives by the own one,
        −10 n / ln 10 (p − A) / d²; those behind a wall are as if the wall stayed between."""
        apart = own - other
        squared = squared_norm(apart).clamp_min(_NEAR)
        strength = self.power - 0.5 * self.slope * squared.log()
        if self.walls:
            strength = strength - self.wall_loss * crossed(own, other, self.walls)
        return strength, -self.slope * apart / squared.unsqueeze(-1)

    def received(
        self,
        strength: Float[Tensor, "R K N A"],
        seen: Bool[Tensor, "R K N A"],
        window: Window,
        name: str,
        dropout: float,
    ) -> dict[str, Tensor]:
        """Leaves ``name`` and its mask: noisy strengths, but for a share that is missing."""
        shape = strength.shape[-2:]
        count = shape[0] * shape[1]
        white = noise.normal(window.keys, name, count).unflatten(-1, shape)
        if dropout:
            drawn = noise.uniform(window.keys, f"{name}.dropout", count)
            seen = seen & (drawn.unflatten(-1, shape) >= dropout)
        noisy = strength.to(torch.float32) + self.std * white
        return {name: noisy.masked_fill(~seen, 0.0), f"{name}_mask": seen.to(torch.float32)}


@dataclass(frozen=True)
class Rssi(Sensor):
    """Leaves ``rssi`` and ``rssi_mask`` [A], and ``rssi_map`` [A · d]: strength in dBm of each of
    the access ``points`` at known places (m), by their ``loss`` on the way. A share ``dropout`` is
    missing."""

    points: tuple[tuple[float, ...], ...]
    loss: PathLoss = PathLoss()
    dropout: float = 0.0

    def __post_init__(self) -> None:
        require(len(self.points) >= 1, self, "points", "at least one access point")
        require(0 <= self.dropout <= 1, self, "dropout", "a probability in [0, 1]")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        count = len(self.points)
        return {"rssi": Leaf(count, unit="dBm"), "rssi_mask": Leaf(count, *MASK)}

    def map_leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {"rssi_map": Leaf(len(self.points) * layout.arena.dim, unit="m", frame="world")}

    def place(self, keys: Tensor, layout: Layout) -> dict[str, Tensor]:
        points = torch.tensor(self.points, dtype=torch.float64, device=keys.device)
        require(points.shape[1] == layout.arena.dim, self, "points", "positions of the room's dim")
        return {"points": points.expand(len(keys), -1, -1)}

    def map_values(self, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        return {"rssi_map": placed["points"].flatten(1).to(torch.float32)}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        own = window.motion.position.unsqueeze(-2)
        strength, _ = self.loss.expected(own, placed["points"][:, None, None])
        seen = window.alive.unsqueeze(-1).expand(strength.shape)
        return self.loss.received(strength, seen, window, "rssi", self.dropout)


@dataclass(frozen=True)
class UavRssi(Sensor):
    """Leaves ``uav_rssi`` and ``uav_rssi_mask`` [S]: strength in dBm of the UAV in each neighbour
    slot, by its ``loss`` on the way, where a signal arrives; each end measures for itself. A share
    ``dropout`` is missing."""

    between_uavs = True

    loss: PathLoss = PathLoss()
    dropout: float = 0.0

    def __post_init__(self) -> None:
        require(0 <= self.dropout <= 1, self, "dropout", "a probability in [0, 1]")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        slots = layout.slots
        return {"uav_rssi": Leaf(slots, unit="dBm"), "uav_rssi_mask": Leaf(slots, *MASK)}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        position = window.motion.position
        strength, _ = self.loss.expected(
            position.unsqueeze(-2), in_slots(position, window.neighbours)
        )
        return self.loss.received(strength, window.reach, window, "uav_rssi", self.dropout)


@dataclass(frozen=True)
class RssiOptions(Group):
    """With ``rssi``, UAVs measure how strongly they receive so many ``access_points``, placed as
    ``anchors`` are, and with ``rssi_uavs`` each other: ``rssi_power`` dBm at 1 m, less 10
    ``rssi_exponent`` dB for each tenfold distance and ``rssi_wall_loss`` dB for each of the
    network's ``walls`` between, with noise of ``rssi_std`` dB. A share ``rssi_dropout`` is missing.
    """

    title: ClassVar[str] = "signal strength"

    rssi: bool = False
    rssi_uavs: bool = False
    access_points: PositiveCount = 4
    rssi_std: Decibels = 4.0
    rssi_power: Power = -40.0
    rssi_exponent: Exponent = 2.2
    rssi_wall_loss: Decibels = 5.0
    rssi_dropout: Share = 0.0

    def loss(self, walls: tuple[Box, ...] = ()) -> PathLoss:
        """What becomes of signals on their way, with walls in it."""
        own = (self.rssi_std, self.rssi_power, self.rssi_exponent)
        return PathLoss(*own, walls, self.rssi_wall_loss)
