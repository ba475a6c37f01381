"""UWB ranging: between UAVs, and from UAVs to fixed anchors."""

import math
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import rotate
from coloc_env.geometry.walls import depth
from coloc_env.motion import Box, Kinematics
from coloc_env.options import Count, Group, Metres, PositiveCount
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
from coloc_env.sensors.errors.clock import Clock
from coloc_env.sensors.errors.range_noise import RangeNoise, RangeOptions
from coloc_env.sensors.sight import Sight

Tags = tuple[tuple[tuple[float, ...], ...], ...]


def tag_positions(motion: Kinematics, tags: Tags) -> Float64[Tensor, "R K N T d"]:
    """World positions of each UAV's UWB tags from their lever arms in the body frame."""
    if not tags:
        return motion.position.unsqueeze(-2)
    arms = motion.position.new_tensor(tags)
    return motion.position.unsqueeze(-2) + rotate(motion.attitude.unsqueeze(-2), arms)


def tag_distances(
    tags: Float64[Tensor, "R K N T d"], neighbours: Int64[Tensor, "#R #K N S"]
) -> Float32[Tensor, "R K N S T T"]:
    """Distances between own tags and the tags of the UAV in each slot.

    Subtracted in float64, one component at a time; then float32 is exact enough.
    """
    squared = None
    for own in tags.unbind(-1):
        theirs = in_slots(own, neighbours)
        apart = (own[:, :, :, None, :, None] - theirs.unsqueeze(-2)).to(torch.float32)
        squared = apart.mul_(apart) if squared is None else squared.addcmul_(apart, apart)
    assert squared is not None
    return squared.sqrt_()


@dataclass(frozen=True)
class Ranging(Sensor):
    """Leaves ``ranges`` and ``range_mask`` [S · T · T]: distance in m to each neighbour slot.

    Entry ``(s · T + a) · T + b`` is between the UAV's own tag ``a`` and tag ``b`` of the neighbour
    in slot ``s`` (T = 1 and no lever arm where ``tags`` is empty). Both ends of a link read the
    same number, drawn once per pair, tags and step. ``latency``: steps between ranging and
    delivery. ``walls``: solid boxes; a range that comes through one (if it does: see ``Network``)
    has the noise's NLOS bias and is too long by ``excess`` times the metres inside. ``clock``: the
    systematic errors of each pair (None: none). ``sight``: what else is in the way.
    """

    between_uavs = True

    noise: RangeNoise = field(default_factory=RangeNoise)
    tags: Tags = ()
    latency: int = 0
    walls: tuple[Box, ...] = ()
    excess: float = 0.0
    clock: Clock | None = None
    sight: Sight = field(default_factory=Sight)

    def __post_init__(self) -> None:
        require(self.latency >= 0, self, "latency", "a number of steps ≥ 0")
        require(0 <= self.excess < math.inf, self, "excess", "metres per metre of wall, ≥ 0")

    @property
    def delay(self) -> int:
        return self.latency

    @property
    def n_tags(self) -> int:
        return len(self.tags[0]) if self.tags else 1

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        width = layout.slots * self.n_tags**2
        return {"ranges": Leaf(width, unit="m"), "range_mask": Leaf(width, *MASK)}

    def place(self, keys: Int64[Tensor, "R"], layout: Layout) -> dict[str, Tensor]:
        return {} if self.clock is None else self.clock.place(keys, layout.arena.n_uavs)

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        motion, keys = window.delayed(self.latency)
        tags, n, t = tag_positions(motion, self.tags), window.layout.arena.n_uavs, self.n_tags
        others = window.neighbours
        index = torch.arange(n * t, device=keys.device).view(n, 1, t, 1)
        other = others[..., None, None] * t + torch.arange(t, device=keys.device)
        lower, upper = torch.minimum(index, other), torch.maximum(index, other)
        distance = tag_distances(tags, others)
        link = noise.fold(keys[..., None, None, None, None], lower * (n * t) + upper)
        pairs = torch.arange(n * t * (n * t + 1) // 2, device=keys.device)

        def by_pair(x: Tensor | None) -> Tensor | None:
            if x is None:
                return None
            among = (upper * (upper + 1) // 2 + lower).expand(distance.shape)
            return x.gather(2, among.flatten(2)).view(distance.shape)

        obstructed = by_pair(self.noise.obstructed(window, pairs, "ranging", self.latency))
        out = by_pair(self.noise.out(window, pairs, "ranging", self.latency))
        bias = by_pair(self.noise.biases(window, pairs, "ranging", self.latency))
        blocked, through = None, None
        if self.walls or not self.sight.clear:
            own, theirs = tags.unsqueeze(3).unsqueeze(-2), in_slots(tags, others).unsqueeze(-3)
        if self.walls:
            inside = depth(own, theirs, self.walls).to(torch.float32)
            blocked = inside > 0
        ranges, lost = self.noise.sample(distance, link, "ranging", blocked, obstructed)
        if bias is not None:
            ranges = ranges.add_(bias)
        if blocked is not None:
            ranges = ranges.add_(inside, alpha=self.excess)
        if self.clock is not None:
            late = self.clock.errors(window, window.steps - self.latency, placed)
            ranges.add_(late[..., None, None])
        if not self.sight.clear:
            through = self.sight.between(window, own, theirs, self.latency)
            ranges.add_(self.sight.lateness(through, link, "ranging"))
        mask = window.reach[..., None, None].expand(ranges.shape)
        if self.latency:
            mask = mask & (window.steps >= self.latency)[..., None, None, None, None]
        for missing in (lost, out, self.sight.lost(through)):
            if missing is not None:
                mask = mask & ~missing
        mask = mask.to(torch.float32)
        return {"ranges": (ranges * mask).flatten(-3), "range_mask": mask.flatten(-3)}


@dataclass(frozen=True)
class UavRangeOptions(RangeOptions):
    """Ranges between UAVs arrive ``uwb_delay`` steps after they were measured."""

    uwb_delay: Count = 0


@dataclass(frozen=True)
class TagOptions(Group):
    """Each UAV carries so many UWB ``tags``, evenly around it in its own plane from forward on,
    ``tag_arm`` m from its position."""

    title: ClassVar[str] = "UWB tags"

    tags: PositiveCount = 1
    tag_arm: Metres = 0.0

    def arms(self, n_uavs: int) -> Tags:
        """Lever arms (m, body frame) of all UAVs in space; nothing for one tag at the position."""
        if self.tags == 1 and not self.tag_arm:
            return ()
        turns = [2 * math.pi * i / self.tags for i in range(self.tags)]
        own = tuple((self.tag_arm * math.cos(t), self.tag_arm * math.sin(t), 0.0) for t in turns)
        return (own,) * n_uavs


@dataclass(frozen=True)
class AnchorOffset:
    """A bias of ``size`` m that all ranges to the first ``anchors`` share, grown linearly from 0
    over the first ``rise`` s."""

    anchors: int = 0
    size: float = 1.0
    rise: float = 0.0

    def at(
        self, steps: Int64[Tensor, "R K"], dt: float, count: int
    ) -> Float32[Tensor, "R K 1 1 A"]:
        """Biases (m) of so many anchors in steps of dt s."""
        time = (steps * dt).to(torch.float32)
        share = (time / self.rise).clamp_max(1.0) if self.rise else torch.ones_like(time)
        biased = torch.arange(count, device=steps.device) < self.anchors
        return self.size * share[..., None, None, None] * biased


@dataclass(frozen=True)
class AnchorRanging(Sensor):
    """Leaves ``anchor_ranges`` and ``anchor_range_mask`` [T · A], and ``anchor_map`` [A · d].

    Entry ``a · A + m`` is between the UAV's own tag ``a`` and anchor ``m``, within ``radius`` m.
    ``blocked``: indices of anchors behind an obstacle, whose ranges all carry the noise's NLOS
    bias; ``offset``: a bias of some. ``walls``: solid boxes that no range passes; ``sight``: what
    else is in the way.
    """

    anchors: tuple[tuple[float, ...], ...]
    noise: RangeNoise = field(default_factory=RangeNoise)
    tags: Tags = ()
    radius: float | None = None
    blocked: tuple[int, ...] = ()
    walls: tuple[Box, ...] = ()
    sight: Sight = field(default_factory=Sight)
    offset: AnchorOffset = field(default_factory=AnchorOffset)

    def __post_init__(self) -> None:
        most = len(self.anchors)
        require(0 <= self.offset.anchors <= most, self, "offset", f"of at most {most} anchors")
        require(len(self.anchors) > 0, self, "anchors", "at least one anchor position")
        known = all(0 <= anchor < len(self.anchors) for anchor in self.blocked)
        require(known, self, "blocked", f"indices of the {len(self.anchors)} anchors")
        require(self.radius is None or self.radius > 0, self, "radius", "a distance in m > 0")

    @property
    def n_tags(self) -> int:
        return len(self.tags[0]) if self.tags else 1

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        width = len(self.anchors) * self.n_tags
        return {"anchor_ranges": Leaf(width, unit="m"), "anchor_range_mask": Leaf(width, *MASK)}

    def map_leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {"anchor_map": Leaf(len(self.anchors) * layout.arena.dim, unit="m", frame="world")}

    def place(self, keys: Int64[Tensor, "R"], layout: Layout) -> dict[str, Tensor]:
        anchors = torch.tensor(self.anchors, dtype=torch.float64, device=keys.device)
        require(
            anchors.shape[1] == layout.arena.dim, self, "anchors", "positions of the room's dim"
        )
        return {"anchors": anchors.expand(len(keys), -1, -1)}

    def map_values(self, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        return {"anchor_map": placed["anchors"].flatten(1).to(torch.float32)}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        tags = tag_positions(window.motion, self.tags)
        apart = tags.unsqueeze(-2) - placed["anchors"][:, None, None, None]  # [R, K, N, T, A, d]
        distance = squared_norm(apart).sqrt_().to(torch.float32)
        count = distance.shape[-3] * distance.shape[-2] * distance.shape[-1]
        index = torch.arange(count, device=distance.device).view(distance.shape[-3:])
        link = noise.fold(window.keys[..., None, None, None], index)
        blocked = None
        if self.blocked:
            blocked = torch.zeros(len(self.anchors), dtype=torch.bool, device=distance.device)
            blocked[list(self.blocked)] = True
        obstructed = self.noise.obstructed(window, index, "anchor_ranging")
        ranges, lost = self.noise.sample(distance, link, "anchor_ranging", blocked, obstructed)
        bias = self.noise.biases(window, index, "anchor_ranging")
        if bias is not None:
            ranges = ranges.add_(bias)
        if self.offset.anchors:
            dt = window.layout.arena.dt
            ranges = ranges + self.offset.at(window.steps, dt, len(self.anchors))
        out, through = self.noise.out(window, index, "anchor_ranging"), None
        if not self.sight.clear:
            through = self.sight.between(
                window, tags.unsqueeze(-2), placed["anchors"][:, None, None, None]
            )
            ranges = ranges.add_(self.sight.lateness(through, link, "anchor_ranging"))
        mask = window.alive[..., None, None].expand(ranges.shape)
        if window.to_anchors is not None:
            mask = mask & window.to_anchors(placed["anchors"])[:, None, :, None]
        if window.targets:
            mask = mask & ~window.is_target[:, None, None]
        if self.radius is not None:
            mask = mask & (distance <= self.radius)
        if self.walls:
            own = tags.unsqueeze(-2).expand_as(apart)
            mask = mask & (depth(own, own - apart, self.walls) == 0)
        for missing in (lost, out, self.sight.lost(through)):
            if missing is not None:
                mask = mask & ~missing
        mask = mask.to(torch.float32)
        return {"anchor_ranges": (ranges * mask).flatten(-2), "anchor_range_mask": mask.flatten(-2)}
