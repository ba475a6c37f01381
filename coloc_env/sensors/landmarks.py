"""Landmarks at known positions, seen as relative position vectors in the body frame."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import rotate, rotation_matrix
from coloc_env.options import Count, Group, Metres, PositiveMetres, Quantity, Seconds, Share
from coloc_env.sensors.base import MASK, Layout, Leaf, Sensor, Window, require, usable
from coloc_env.sensors.sight import Sight

FieldOfView = Annotated[float, Quantity("rad", above=0.0, most=2 * math.pi)]


def uniform_points(keys: Int64[Tensor, "R"], stream: str, count: int, layout: Layout) -> Tensor:
    """Positions [R, count, d] float64, uniform in the arena."""
    arena = layout.arena
    unit = noise.uniform(keys, stream, count * arena.dim).unflatten(-1, (count, arena.dim)).double()
    low = unit.new_tensor(arena.low)
    return low + unit * (unit.new_tensor(arena.high) - low)


@dataclass(frozen=True)
class Landmarks(Sensor):
    """Leaves ``landmarks`` [L · d], ``landmark_mask`` [L] and ``landmark_map`` [L · d].

    Entry ``l`` is z = Rᵀ(L_l − p) + N(0, std² I), body frame, metres, for landmarks within
    ``radius``; landmarks are drawn uniformly in the arena for every world unless ``positions``
    gives them. ``false_matches``: fraction of measurements that belong to another landmark;
    ``dropout``: fraction that is missing; ``off``: times (from, to) in s without any.
    ``field_of_view``: full opening angle (rad) of the cone about the body's x axis in which they
    are seen (None: all around; in the plane a sector). ``sight``: what hides them.
    """

    count: int = 20
    std: float = 0.15
    radius: float = 10.0
    false_matches: float = 0.0
    dropout: float = 0.0
    off: tuple[float, float] | None = None
    positions: tuple[tuple[float, ...], ...] | None = None
    field_of_view: float | None = None
    sight: Sight = field(default_factory=Sight)

    def __post_init__(self) -> None:
        require(
            self.count >= 1, self, "count", "at least one landmark (leave the sensor out for 0)"
        )
        require(self.std >= 0, self, "std", "a standard deviation in m ≥ 0")
        require(self.radius > 0, self, "radius", "a distance in m > 0")
        for name in ("false_matches", "dropout"):
            require(0 <= getattr(self, name) <= 1, self, name, "a fraction in [0, 1]")
        require(
            self.off is None or self.off[0] <= self.off[1],
            self,
            "off",
            "(from, to) in s, from ≤ to",
        )
        angle = self.field_of_view is None or 0 < self.field_of_view <= 2 * math.pi
        require(angle, self, "field_of_view", "an opening angle in rad, above 0 and up to 2π")

    @property
    def fix_slots(self) -> int:
        return self.count

    def fixes(
        self, leaves: Mapping[str, Float32[Tensor, "B N F"]], attitude: Float32[Tensor, "B N a"]
    ) -> tuple[Float32[Tensor, "B N m d"], Bool[Tensor, "B N m"]]:
        shape = (self.count, -1)
        z, there = usable(leaves["landmarks"].unflatten(-1, shape), leaves["landmark_mask"] > 0)
        apart = rotate(attitude.unsqueeze(-2), z)
        return leaves["landmark_map"].unflatten(-1, shape) - apart, there

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {
            "landmarks": Leaf(self.count * layout.arena.dim, unit="m", frame="body"),
            "landmark_mask": Leaf(self.count, *MASK),
        }

    def map_leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {"landmark_map": Leaf(self.count * layout.arena.dim, unit="m", frame="world")}

    def place(self, keys: Int64[Tensor, "R"], layout: Layout) -> dict[str, Tensor]:
        if self.positions is None:
            return {"positions": uniform_points(keys, "landmarks.place", self.count, layout)}
        given = torch.tensor(self.positions, dtype=torch.float64, device=keys.device)
        shape = (self.count, layout.arena.dim)
        require(
            given.shape == shape, self, "positions", f"{shape[0]} positions of {shape[1]} numbers"
        )
        return {"positions": given.expand(len(keys), -1, -1)}

    def map_values(self, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        return {"landmark_map": placed["positions"].flatten(1).to(torch.float32)}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        motion, keys, n = window.motion, window.keys, window.layout.arena.n_uavs
        dim = motion.position.shape[-1]
        # One contiguous tensor [R, K, N, L] per component: elementwise work at full speed.
        own = [c.unsqueeze(-1) for c in motion.position.unbind(-1)]
        points = [c.contiguous()[:, None, None] for c in placed["positions"].unbind(-1)]
        apart = [(point - p).to(torch.float32) for point, p in zip(points, own, strict=True)]
        squared = apart[0] * apart[0]
        for component in apart[1:]:
            squared = squared.addcmul_(component, component)
        # Straight to float32: a comparison into a mask of bools takes twice as long.
        reach = torch.full_like(window.alive, -1.0, dtype=torch.float32)
        reach = reach.masked_fill(window.alive, self.radius**2).unsqueeze(-1)
        rotation = rotation_matrix(motion.attitude.to(torch.float32))
        if self.field_of_view is not None:
            reach = torch.where(self._ahead(rotation, apart, squared), reach, -1.0)
        visible = torch.le(squared, reach, out=squared)
        if not self.sight.clear:
            ends = motion.position.unsqueeze(-2), placed["positions"][:, None, None]
            hidden = self.sight.between(window, *ends) > 0
            visible.masked_fill_(hidden, 0.0)
        if self.false_matches:
            draws = noise.uniform(keys, "landmarks.false", 2 * n * self.count)
            wrong, other = draws.unflatten(-1, (2, n, self.count)).unbind(-3)
            index = torch.arange(self.count, device=keys.device)
            shift = 1 + (other * (self.count - 1)).to(torch.int64)
            index = torch.where(wrong < self.false_matches, (index + shift) % self.count, index)
            apart = [component.gather(-1, index) for component in apart]
        if self.dropout:
            missing = noise.uniform(keys, "landmarks.dropout", n * self.count) < self.dropout
            visible.masked_fill_(missing.unflatten(-1, (n, self.count)), 0.0)
        if self.off is not None:
            time = window.steps * window.layout.arena.dt
            blind = (time >= self.off[0]) & (time < self.off[1])
            visible.masked_fill_(blind[..., None, None], 0.0)
        seen = noise.normal(keys, "landmarks", n * self.count * dim)
        seen = seen.unflatten(-1, (n, self.count, dim)).mul_(self.std)
        for column in range(dim):
            value = rotation[..., 0, column, None] * apart[0]
            for row in range(1, dim):
                value.addcmul_(rotation[..., row, column, None], apart[row])
            seen[..., column].add_(value).mul_(visible)
        return {"landmarks": seen.flatten(-2), "landmark_mask": visible}

    def _ahead(
        self,
        rotation: Float32[Tensor, "R K N d d"],
        apart: list[Float32[Tensor, "R K N L"]],
        squared: Float32[Tensor, "R K N L"],
    ) -> Bool[Tensor, "R K N L"]:
        """Which landmarks lie in the field of view: z₁ ≥ ‖z‖ cos(φ / 2), z = Rᵀ(L − p)."""
        assert self.field_of_view is not None
        forward = rotation[..., 0, 0, None] * apart[0]
        for row in range(1, len(apart)):
            forward.addcmul_(rotation[..., row, 0, None], apart[row])
        return forward >= math.cos(0.5 * self.field_of_view) * squared.sqrt()


@dataclass(frozen=True)
class LandmarkOptions(Group):
    """So many ``landmarks`` stand anywhere in the arena; those within ``landmark_radius`` m are
    seen as position vectors with noise of ``landmark_std`` m per axis. A share ``false_matches`` of
    these belongs to another landmark, a share ``landmark_dropout`` is missing, and in the times
    ``range_only`` (from, to) none is seen. ``landmark_field``: full opening angle of the cone about
    the body's x axis in which they are seen (none: all around). The team believes the Gaussian part
    alone.
    """

    title: ClassVar[str] = "landmarks"

    landmarks: Count = 20
    landmark_std: Metres = 0.15
    landmark_radius: PositiveMetres = 10.0
    false_matches: Share = 0.0
    landmark_dropout: Share = 0.0
    range_only: tuple[Seconds, Seconds] | None = None
    landmark_field: FieldOfView | None = None

    @property
    def true(self) -> tuple[Landmarks, ...]:
        """The sensor as it is, with nothing in the way; nothing without landmarks."""
        seen = self._seen(self.false_matches, self.landmark_dropout, self.range_only)
        return tuple(replace(one, field_of_view=self.landmark_field) for one in seen)

    def behind(self, sight: Sight) -> tuple[Landmarks, ...]:
        """The sensor as it is, with what hides landmarks."""
        return tuple(replace(one, sight=sight) for one in self.true)

    @property
    def believed(self) -> tuple[Landmarks, ...]:
        """The sensor that the team believes in; nothing without landmarks."""
        return self._seen()

    def _seen(self, *wrong: Any) -> tuple[Landmarks, ...]:
        if not self.landmarks:
            return ()
        return (Landmarks(self.landmarks, self.landmark_std, self.landmark_radius, *wrong),)
