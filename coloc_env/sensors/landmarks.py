"""Landmarks at known positions, seen as relative position vectors in the body frame."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

import torch
from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import rotate, rotation_matrix
from coloc_env.options import (
    Quantity,
)
from coloc_env.sensors.base import MASK, Layout, Leaf, Sensor, Window, require, usable
from coloc_env.sensors.errors.persistence import held_uniform
from coloc_env.sensors.sight import Sight

FieldOfView = Annotated[float, Quantity("rad", above=0.0, most=2 * math.pi)]
Placement = Literal["random", "symmetric"]


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
    gives them; with ``placement="symmetric"`` every second one is where half a turn about the
    arena's vertical axis takes the one before, and the last of an odd number on that axis.
    ``false_matches``: fraction of measurements that belong to another landmark, drawn in every
    step, or, with ``alias_time``, to the same one for that long (s; a Markov chain whose
    correlation falls by e in that time); ``dropout``: fraction that is missing; ``off``: times
    (from, to) in s without any. ``field_of_view``: full opening angle (rad) of the cone about the
    body's x axis in which they are seen (None: all around; in the plane a sector). ``sight``: what
    hides them.
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
    alias_time: float | None = None
    placement: Placement = "random"

    def __post_init__(self) -> None:
        require(
            self.count >= 1, self, "count", "at least one landmark (leave the sensor out for 0)"
        )
        require(self.std >= 0, self, "std", "a standard deviation in m ≥ 0")
        require(self.radius > 0, self, "radius", "a distance in m > 0")
        for name in ("false_matches", "dropout"):
            require(0 <= getattr(self, name) <= 1, self, name, "a fraction in [0, 1]")
        lasting = self.alias_time is None or 0 < self.alias_time < float("inf")
        require(lasting, self, "alias_time", "a time in s > 0")
        kinds = get_args(Placement)
        require(self.placement in kinds, self, "placement", f"one of {', '.join(kinds)}")
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
            drawn = uniform_points(keys, "landmarks.place", self.count, layout)
            symmetric = self.placement == "symmetric"
            return {"positions": _half_turned(drawn, layout) if symmetric else drawn}
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
            wrong, other = self._mistaken(window)
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

    def _mistaken(
        self, window: Window
    ) -> tuple[Float32[Tensor, "R K N L"], Float32[Tensor, "R K N L"]]:
        """Numbers in (0, 1): where the first is below the share of false matches the landmark is
        taken for another, which the second chooses."""
        n = window.layout.arena.n_uavs
        if self.alias_time is None:
            draws = noise.uniform(window.keys, "landmarks.false", 2 * n * self.count)
            wrong, other = draws.unflatten(-1, (2, n, self.count)).unbind(-3)
            return wrong, other
        links = torch.arange(n * self.count, device=window.keys.device).view(n, self.count)
        first, count = window.steps[:, 0], window.steps.shape[1]
        time = self.alias_time / window.layout.arena.dt
        wrong = held_uniform(window.rows, first, count, links, "landmarks.alias", time)
        return wrong, (wrong / self.false_matches).clamp_max(1 - 2**-23)


def _half_turned(points: Float64[Tensor, "R L d"], layout: Layout) -> Float64[Tensor, "R L d"]:
    """Every second point where half a turn about the arena's vertical axis takes the one before;
    the last of an odd number on that axis."""
    arena = layout.arena
    ends = zip(arena.low[:2], arena.high[:2], strict=True)
    centre = points.new_tensor([0.5 * (low + high) for low, high in ends])
    first = points[:, ::2].clone()
    if points.shape[1] % 2:
        first[:, -1, :2] = centre
    turned = torch.cat((2 * centre - first[..., :2], first[..., 2:]), -1)
    return torch.stack((first, turned), 2).flatten(1, 2)[:, : points.shape[1]]
