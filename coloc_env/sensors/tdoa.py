"""Time differences of arrival: how much farther one anchor is than another."""

from dataclasses import dataclass

import torch
from torch import Tensor

from coloc_env import noise
from coloc_env.sensors.base import MASK, Layout, Leaf, Sensor, Window, require, squared_norm
from coloc_env.sensors.ranging import Tags, tag_positions

Pairs = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Tdoa(Sensor):
    """Leaves ``tdoa`` and ``tdoa_mask`` [D · T · P], and ``tdoa_map`` [A · d].

    Entry ``(k · T + a) · P + q`` is ‖t − A_n‖ − ‖t − A_m‖ + N(0, ``std``²) in m, t the UAV's tag
    ``a`` and (m, n) the anchors of pair ``q``. UAVs only listen, so that any number of them can.
    ``pairs``: of anchors (none: each and the next one, the last and the first, as anchors that send
    in turn are heard: Hamer & D'Andrea, "Self-calibrating ultra-wideband network supporting
    multi-robot localization", IEEE Access 6, 2018; what Crazyflies fly). ``depth`` D: how many
    measurements of one pair a step can deliver. A share ``dropout`` is missing; ``radius``: both
    anchors lie within so many m. A share ``tail`` has noise of ``tail_std`` m instead: of either
    sign, since it is late if the way to A_n is blocked, and early if that to A_m is.
    """

    anchors: tuple[tuple[float, ...], ...]
    std: float = 0.15
    tags: Tags = ()
    pairs: Pairs = ()
    depth: int = 1
    dropout: float = 0.0
    radius: float | None = None
    tail: float = 0.0
    tail_std: float = 1.0

    def __post_init__(self) -> None:
        count = len(self.anchors)
        require(count >= 2, self, "anchors", "at least two anchor positions")
        require(self.std >= 0, self, "std", "a standard deviation in m ≥ 0")
        known = all(m != n and 0 <= m < count and 0 <= n < count for m, n in self.pairs)
        require(known, self, "pairs", f"pairs of different indices of the {count} anchors")
        require(0 <= self.tail <= 1, self, "tail", "a probability in [0, 1]")
        require(self.tail_std >= 0, self, "tail_std", "a standard deviation in m ≥ 0")
        require(self.depth >= 1, self, "depth", "at least one measurement")
        require(0 <= self.dropout <= 1, self, "dropout", "a probability in [0, 1]")
        require(self.radius is None or self.radius > 0, self, "radius", "a distance in m > 0")

    @property
    def n_tags(self) -> int:
        return len(self.tags[0]) if self.tags else 1

    @property
    def ends(self) -> tuple[list[int], list[int]]:
        """Indices m and n of the anchors of each pair."""
        count = len(self.anchors)
        turns = count if count > 2 else 1  # two anchors have one difference
        pairs = self.pairs or tuple((m, (m + 1) % count) for m in range(turns))
        return [m for m, _ in pairs], [n for _, n in pairs]

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        width = self.depth * self.n_tags * len(self.ends[0])
        return {"tdoa": Leaf(width, unit="m"), "tdoa_mask": Leaf(width, *MASK)}

    def map_leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {"tdoa_map": Leaf(len(self.anchors) * layout.arena.dim, unit="m", frame="world")}

    def place(self, keys: Tensor, layout: Layout) -> dict[str, Tensor]:
        anchors = torch.tensor(self.anchors, dtype=torch.float64, device=keys.device)
        fits = anchors.shape[1] == layout.arena.dim
        require(fits, self, "anchors", "positions of the room's dim")
        return {"anchors": anchors.expand(len(keys), -1, -1)}

    def map_values(self, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        return {"tdoa_map": placed["anchors"].flatten(1).to(torch.float32)}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        tags, (m, n) = tag_positions(window.motion, self.tags), self.ends
        apart = tags.unsqueeze(-2) - placed["anchors"][:, None, None, None]  # [R, K, N, T, A, d]
        distance = squared_norm(apart).sqrt_()
        exact = (distance[..., n] - distance[..., m]).to(torch.float32).flatten(-2)
        exact = exact.repeat(1, 1, 1, self.depth)
        shape = exact.shape[-2:]
        white = noise.normal(window.keys, "tdoa", shape[0] * shape[1]).unflatten(-1, shape)
        heard = window.alive.unsqueeze(-1).expand(exact.shape)
        if window.targets:
            heard = heard & ~window.is_target[:, None]
        if self.radius is not None:
            near = torch.maximum(distance[..., n], distance[..., m]) <= self.radius
            heard = heard & near.flatten(-2).repeat(1, 1, 1, self.depth)
        if self.dropout:
            drawn = noise.uniform(window.keys, "tdoa.dropout", shape[0] * shape[1])
            heard = heard & (drawn.unflatten(-1, shape) >= self.dropout)
        mask, error = heard.to(torch.float32), self.std * white
        if self.tail:
            drawn = noise.uniform(window.keys, "tdoa.tail", shape[0] * shape[1])
            wild = drawn.unflatten(-1, shape) < self.tail
            error = torch.where(wild, self.tail_std * white, error)
        return {"tdoa": (exact + error) * mask, "tdoa_mask": mask}
