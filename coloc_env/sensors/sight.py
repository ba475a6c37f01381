"""What stands in a line of sight: walls, and obstacles that move."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry.walls import crossed, near
from coloc_env.motion import Arena, Box, Waypoints
from coloc_env.options import Count, Group, Metres, PositiveMetres, PositiveSpeed, Quantity
from coloc_env.sensors.base import Window, require

WallDelay = Annotated[float, Quantity("m", 0.0, infinite=True)]


@dataclass(frozen=True)
class Sight:
    """``walls``, solid boxes (m), and ``obstacles``: so many columns of ``radius`` m from the floor
    to the ceiling, each on its own way between random waypoints at up to ``speed`` m/s.

    Landmarks are not seen through any of them. A radio's signal that passes through k of them makes
    a range k · ``delay`` m longer, and adds noise of variance k · ``std``² (m²), drawn once a link
    and step; with an infinite ``delay`` nothing gets through. Obstacles are a pure function of the
    world's seed and the step. UAVs take no notice of them, and are seen by nobody in one.
    """

    walls: tuple[Box, ...] = ()
    obstacles: int = 0
    radius: float = 0.4
    speed: float = 1.0
    delay: float = 0.3
    std: float = 0.2

    def __post_init__(self) -> None:
        require(self.obstacles >= 0, self, "obstacles", "a number ≥ 0")
        require(self.radius > 0, self, "radius", "a radius in m > 0")
        require(self.delay >= 0, self, "delay", "metres a wall, ≥ 0")
        require(0 <= self.std < math.inf, self, "std", "a standard deviation in m ≥ 0")

    @property
    def clear(self) -> bool:
        """Whether nothing ever stands in the way."""
        return not (self.walls or self.obstacles)

    def places(
        self, rows: Int64[Tensor, "R"], steps: Int64[Tensor, "R K"], arena: Arena
    ) -> Float64[Tensor, "R K C d"]:
        """Where the obstacles' axes are (m), in worlds of these keys."""
        moving = Arena(arena.dim, self.obstacles, arena.dt, arena.low, arena.high)
        motion = Waypoints(max_speed=self.speed, margin=min(self.radius, 0.25 * _narrowest(arena)))
        keys = noise.fold(rows, _OBSTACLES)
        return motion.advance(motion.start(keys, moving), steps, moving)[0].position

    def between(
        self,
        window: Window,
        start: Float64[Tensor, "R K *#s d"],
        end: Float64[Tensor, "R K *#s d"],
        latency: int = 0,
    ) -> Int64[Tensor, "R K *s"]:
        """How many walls and obstacles each segment (m) passes, ``latency`` steps before each of
        the window's; the same number from either end."""
        count = crossed(start, end, self.walls)
        if self.obstacles:
            steps = (window.steps - latency).clamp_min(0)
            places = self.places(window.rows, steps, window.layout.arena)
            for centre in places.unbind(2):
                shape = (*centre.shape[:2], *(1,) * (count.dim() - 2), centre.shape[-1])
                count += near(start, end, centre.view(shape), self.radius)
        return count

    def lost(self, count: Int64[Tensor, "*s"] | None) -> Bool[Tensor, "*s"] | None:
        """Which ranges do not arrive; None where all do."""
        return None if count is None or self.delay < math.inf else count > 0

    def lateness(
        self, count: Int64[Tensor, "*s"], keys: Int64[Tensor, "*#s"], stream: str
    ) -> Float32[Tensor, "*s"]:
        """What ``count`` walls add to a range (m), by the link's own keys."""
        if self.delay == math.inf:  # lost, not late
            return torch.zeros_like(count, dtype=torch.float32)
        walls = count.to(torch.float32)
        late = self.delay * walls
        if self.std and bool((count > 0).any()):
            late = late + self.std * walls.sqrt() * noise.normal(keys, f"{stream}.wall", 1)[..., 0]
        return late


_OBSTACLES = 0x0B57  # what sets the obstacles' keys apart from the UAVs'


def _narrowest(arena: Arena) -> float:
    """The arena's shortest side (m)."""
    return min(high - low for low, high in zip(arena.low, arena.high, strict=True))


@dataclass(frozen=True)
class SightOptions(Group):
    """``walls`` and so many ``obstacles`` (columns of ``obstacle_radius`` m from floor to ceiling,
    on the move between waypoints at up to ``obstacle_speed``) hide landmarks. A range through k of
    them is k times ``wall_delay`` longer (inf: there is none, and no message through walls) and
    has noise of ``wall_std`` m times √k besides. The team does not know of them.
    """

    title: ClassVar[str] = "line of sight"

    wall_delay: WallDelay = 0.3
    wall_std: Metres = 0.2
    obstacles: Count = 0
    obstacle_radius: PositiveMetres = 0.4
    obstacle_speed: PositiveSpeed = 1.0

    def sight(self, walls: tuple[Box, ...]) -> Sight:
        """What stands in the way, with these walls."""
        radius, speed = self.obstacle_radius, self.obstacle_speed
        return Sight(walls, self.obstacles, radius, speed, self.wall_delay, self.wall_std)
