"""Received signal strength of access points at known places."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry.walls import depth
from coloc_env.motion import Box
from coloc_env.options import Coordinate, Group, PositiveCount, Quantity, Share
from coloc_env.sensors.base import MASK, Layout, Leaf, Sensor, Window, require, squared_norm

_NEAR = 0.01  # m²: nearer than 0.1 m the strength grows no more
Decibels = Annotated[float, Quantity("dB", 0.0)]
Power = Annotated[float, Quantity("dBm")]
Exponent = Annotated[float, Quantity("", above=0.0)]


@dataclass(frozen=True)
class Rssi(Sensor):
    """Leaves ``rssi`` and ``rssi_mask`` [A], and ``rssi_map`` [A · d].

    Entry ``m`` is P₀ − 10 n log₁₀ d + N(0, ``std``²) in dBm, d (m) the distance to access point m,
    less ``wall_loss`` dB for each of the ``walls`` between (log-distance path loss with partition
    losses: Rappaport, "Wireless Communications", 2002, sections 4.9 to 4.11). ``power`` P₀: at 1 m;
    ``exponent`` n. A share ``dropout`` is missing.
    """

    points: tuple[tuple[float, ...], ...]
    std: float = 4.0
    power: float = -40.0
    exponent: float = 2.2
    walls: tuple[Box, ...] = ()
    wall_loss: float = 5.0
    dropout: float = 0.0

    def __post_init__(self) -> None:
        require(len(self.points) >= 1, self, "points", "at least one access point")
        require(0 <= self.std < math.inf, self, "std", "a standard deviation in dB ≥ 0")
        require(0 < self.exponent < math.inf, self, "exponent", "a number > 0")
        require(0 <= self.wall_loss < math.inf, self, "wall_loss", "a loss in dB ≥ 0")
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

    def expected(
        self, position: Float[Tensor, "*#s 1 d"], points: Float[Tensor, "*#s A d"]
    ) -> tuple[Float[Tensor, "*s A"], Float[Tensor, "*s A d"]]:
        """Strengths (dBm), and their derivatives by the position, −10 n / ln 10 (p − A) / d²; those
        of what is behind a wall are as if the wall stayed between."""
        apart = position - points
        squared = squared_norm(apart).clamp_min(_NEAR)
        slope = 10 * self.exponent / math.log(10)
        strength = self.power - 0.5 * slope * squared.log()
        for wall in self.walls:
            behind = depth(position, points, (wall,)) > 0
            strength = strength - self.wall_loss * behind
        return strength, -slope * apart / squared.unsqueeze(-1)

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        own = window.motion.position.unsqueeze(-2)
        strength, _ = self.expected(own, placed["points"][:, None, None])
        shape = strength.shape[-2:]
        white = noise.normal(window.keys, "rssi", shape[0] * shape[1]).unflatten(-1, shape)
        seen = window.alive.unsqueeze(-1).expand(strength.shape)
        if self.dropout:
            drawn = noise.uniform(window.keys, "rssi.dropout", shape[0] * shape[1])
            seen = seen & (drawn.unflatten(-1, shape) >= self.dropout)
        mask = seen.to(torch.float32)
        return {"rssi": (strength.to(torch.float32) + self.std * white) * mask, "rssi_mask": mask}


@dataclass(frozen=True)
class RssiOptions(Group):
    """With ``rssi``, UAVs measure how strongly they receive so many ``access_points``, placed as
    ``anchors`` are: ``rssi_power`` dBm at 1 m, less 10 ``rssi_exponent`` dB for each tenfold
    distance and ``rssi_wall_loss`` dB for each of the network's ``walls`` between, with noise of
    ``rssi_std`` dB. A share ``rssi_dropout`` is missing."""

    title: ClassVar[str] = "signal strength"

    rssi: bool = False
    access_points: PositiveCount = 4
    rssi_std: Decibels = 4.0
    rssi_power: Power = -40.0
    rssi_exponent: Exponent = 2.2
    rssi_wall_loss: Decibels = 5.0
    rssi_dropout: Share = 0.0

    def true(self, places: tuple[tuple[Coordinate, ...], ...], walls: tuple[Box, ...] = ()) -> Rssi:
        """The sensor as it is, with access points at ``places`` (m)."""
        own = (self.rssi_std, self.rssi_power, self.rssi_exponent)
        return Rssi(places, *own, walls, self.rssi_wall_loss, self.rssi_dropout)
