"""Who hears whom: radius, occlusion, message loss, and which neighbours a UAV has slots for."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry.walls import depth
from coloc_env.motion import Box
from coloc_env.options import Coordinate, Count, Group, PositiveCount, PositiveMetres, Share
from coloc_env.sensors.base import in_slots, require, squared_norm

Links = Literal["all", "chosen", "broadcast"]

_BLOCK = 131072  # pairs of UAVs compared at once on a CPU: what stays in cache
_SHADOWING = 4.0  # dB, standard deviation: IEEE 802.15.4a channel model, office without sight, 3.9
_PER_DECIBEL = math.log(10) / 10  # what makes a power's ratio of decibels


@dataclass(frozen=True)
class Network:
    """Radio between UAVs.

    ``radius``: reach in m (None: everybody). ``walls``: solid boxes ((low), (high)) in m that block
    the line of sight; with a finite ``wall_loss``, in dB per metre inside them, a signal gets
    through as long as it is then no weaker than one that comes in sight from ``radius`` m (power
    falls with the square of the distance), give or take a shadowing of N(0, 4²) dB, drawn once per
    pair and step. ``loss``: probability that one directed link carries nothing in one step.
    ``failure``: probability that a link is broken in one step: neither ranges nor messages pass,
    either way.
    ``delay``: further steps a message needs beyond the one it always takes. ``max_neighbours``:
    teams of up to this size have one slot per UAV; in larger ones each UAV has this many slots, for
    the nearest UAVs in reach.

    ``links``: who exchanges with whom in a step. ``all``: everybody in reach, both ways;
    ``chosen``: each UAV may initiate one exchange with another UAV or an anchor, which fails if its
    target initiates, or any other initiator is within ``interference`` m of the target (None: the
    radius) or has the same target; ``broadcast``: each UAV speaks or listens, and who hears exactly
    one ranges to it and gets its message.
    """

    radius: float | None = None
    walls: tuple[Box, ...] = ()
    loss: float = 0.0
    delay: int = 0
    max_neighbours: int = 16
    failure: float = 0.0
    wall_loss: float = math.inf
    links: Links = "all"
    interference: float | None = None

    def __post_init__(self) -> None:
        require(self.radius is None or self.radius > 0, self, "radius", "a distance in m > 0")
        require(0 <= self.loss <= 1, self, "loss", "a probability in [0, 1]")
        require(0 <= self.failure <= 1, self, "failure", "a probability in [0, 1]")
        require(self.delay >= 0, self, "delay", "a number of steps ≥ 0")
        require(self.max_neighbours >= 1, self, "max_neighbours", "at least one slot")
        require(self.wall_loss >= 0, self, "wall_loss", "a loss in dB per metre ≥ 0")
        kinds = get_args(Links)
        require(self.links in kinds, self, "links", f"one of {', '.join(kinds)}")
        near = self.interference is None or self.interference > 0
        require(near, self, "interference", "a distance in m > 0")
        known = self.wall_loss in (0.0, math.inf) or self.radius is not None
        require(known, self, "wall_loss", "0 or infinite, unless there is a radius")

    def slots(self, n_uavs: int) -> int:
        """Neighbour slots of every UAV: its own index included where each UAV has one."""
        return n_uavs if self.dense(n_uavs) else self.max_neighbours

    def dense(self, n_uavs: int) -> bool:
        """Whether slot j simply is UAV j."""
        return n_uavs <= self.max_neighbours

    def neighbours(
        self, position: Float64[Tensor, "R K N d"], alive: Bool[Tensor, "R K N"]
    ) -> tuple[Int64[Tensor, "#R #K N S"], Bool[Tensor, "R K N S"]]:
        """Which UAV each slot holds, and whether its signal reaches the slot's owner."""
        n = position.shape[2]
        if self.dense(n):
            index = torch.arange(n, device=position.device).expand(1, 1, n, n)
            reach = alive.unsqueeze(2) & alive.unsqueeze(3)
            reach.diagonal(dim1=-2, dim2=-1).fill_(False)
            if self.radius is not None:
                reach &= _squared_distances(position) <= self.radius**2
            if self._opaque:
                reach &= ~(depth(position.unsqueeze(3), position.unsqueeze(2), self.walls) > 0)
            return index, reach
        pairs = _BLOCK if position.device.type == "cpu" else alive.numel() * n
        block = max(1, pairs // (n * n))
        blocks = zip(
            position.flatten(0, 1).split(block), alive.flatten(0, 1).split(block), strict=True
        )
        parts = zip(*(self._nearest(*part) for part in blocks), strict=True)
        index, reach = (torch.cat(part) for part in parts)
        return index.unflatten(0, position.shape[:2]), reach.unflatten(0, position.shape[:2])

    def _nearest(
        self, position: Float64[Tensor, "I N d"], alive: Bool[Tensor, "I N"]
    ) -> tuple[Int64[Tensor, "I N S"], Bool[Tensor, "I N S"]]:
        """The nearest UAVs in reach, by one sort of unique integers (distance bits, then index)."""
        n = position.shape[1]
        about = (position - position[:, :1]).to(torch.float32)  # exact enough about a local origin
        squared = about.new_zeros(len(position), n, n)
        for c in about.unbind(-1):
            apart = c.unsqueeze(1) - c.unsqueeze(2)
            squared.addcmul_(apart, apart)
        squared.diagonal(dim1=-2, dim2=-1).fill_(float("inf"))
        squared.masked_fill_(~alive.unsqueeze(1), float("inf"))
        if self._opaque:
            blocked = depth(position.unsqueeze(2), position.unsqueeze(1), self.walls) > 0
            squared.masked_fill_(blocked, float("inf"))
        # A non-negative float32 orders like its bits read as an integer; the index makes it unique.
        order = squared.view(torch.int32).to(torch.int64).bitwise_left_shift_(20)
        order.bitwise_or_(torch.arange(n, device=position.device))
        order = _sorted(order)[..., : self.max_neighbours]
        limit = float("inf") if self.radius is None else self.radius**2
        distance = (order >> 20).to(torch.int32).view(torch.float32)
        reach = (distance <= limit) & (distance < float("inf")) & alive.unsqueeze(-1)
        return order & 0xFFFFF, reach

    @property
    def _opaque(self) -> bool:
        """Whether nothing at all gets through the walls."""
        return bool(self.walls) and self.wall_loss == math.inf

    def unbroken(
        self,
        keys: Int64[Tensor, "R K"],
        neighbours: Int64[Tensor, "#R #K N S"],
        reach: Bool[Tensor, "R K N S"],
        position: Float64[Tensor, "R K N d"],
    ) -> Bool[Tensor, "R K N S"]:
        """``reach`` without the links that are broken in each step, and those that do not get
        through a wall: the same ones at both ends."""
        fading = bool(self.walls) and not self._opaque and self.radius is not None
        if not (self.failure or fading):
            return reach
        n = reach.shape[2]
        own = torch.arange(n, device=keys.device).unsqueeze(-1)
        pair = torch.minimum(own, neighbours) * n + torch.maximum(own, neighbours)
        undirected = noise.fold(keys[..., None, None], pair)
        if self.failure:
            whole = noise.uniform(undirected, "network.failure", 1)[..., 0] >= self.failure
            reach = reach & whole
        return reach & self._through(undirected, neighbours, position) if fading else reach

    def _through(
        self,
        keys: Int64[Tensor, "R K N S"],
        neighbours: Int64[Tensor, "#R #K N S"],
        position: Float64[Tensor, "R K N d"],
    ) -> Bool[Tensor, "R K N S"]:
        """Which links are in sight, or strong enough to get through the walls between."""
        assert self.radius is not None
        own, other = position.unsqueeze(3), in_slots(position, neighbours)
        inside = depth(own, other, self.walls)
        if not bool((inside > 0).any()):
            return torch.ones_like(inside, dtype=torch.bool)
        apart = squared_norm(own - other)
        shadowing = _SHADOWING * noise.normal(keys, "network.shadowing", 1)[..., 0]
        loss = (_PER_DECIBEL * (self.wall_loss * inside + shadowing)).exp()
        return (inside == 0) | (apart * loss <= self.radius**2)

    def delivered(
        self,
        keys: Int64[Tensor, "R K"],
        neighbours: Int64[Tensor, "#R #K N S"],
        reach: Bool[Tensor, "R K N S"],
    ) -> Bool[Tensor, "R K N S"]:
        """Which slots' transmissions get through in each step: reach and no loss."""
        if not self.loss:
            return reach
        n = reach.shape[2]
        receiver = torch.arange(n, device=keys.device).unsqueeze(-1)
        directed = noise.fold(keys[..., None, None], receiver * n + neighbours)
        return reach & (noise.uniform(directed, "network.loss", 1)[..., 0] >= self.loss)


@dataclass(frozen=True)
class NetworkOptions(Group):
    """UAVs up to ``comm_radius`` m apart (none: however far) measure each other and exchange
    messages. In each step a link is broken for both with probability ``link_failure``, and carries
    no message one way with probability ``message_loss``; messages take ``message_delay`` steps more
    than the one that they always take. ``links``: ``all`` in reach exchange; or the team's actions
    say who calls whom (``chosen``; others' calls within ``interference`` of the one called, none:
    ``comm_radius``, spoil it) or who speaks (``broadcast``).
    """

    title: ClassVar[str] = "network"

    comm_radius: PositiveMetres | None = None
    link_failure: Share = 0.0
    message_loss: Share = 0.0
    message_delay: Count = 0
    links: Links = "all"
    interference: PositiveMetres | None = None

    def network(self, **others: Any) -> Network:
        """The network; ``others``: fields of ``Network`` that are no options."""
        return Network(
            radius=self.comm_radius,
            loss=self.message_loss,
            delay=self.message_delay,
            failure=self.link_failure,
            links=self.links,
            interference=self.interference,
            **others,
        )


@dataclass(frozen=True)
class WalledNetworkOptions(NetworkOptions):
    """``walls``: solid boxes ``x0,y0,z0,x1,y1,z1`` (several: one after the other). In teams of more
    than ``max_neighbours`` each UAV has as many, the nearest."""

    max_neighbours: PositiveCount = 16
    walls: tuple[Coordinate, ...] | None = None

    def network(self, **others: Any) -> Network:
        walls = self.walls or ()
        if len(walls) % 6:
            raise ValueError(f"walls={walls} is not allowed: six numbers a box, x0,y0,z0,x1,y1,z1")
        boxes = tuple((walls[i : i + 3], walls[i + 3 : i + 6]) for i in range(0, len(walls), 6))
        return super().network(walls=boxes, max_neighbours=self.max_neighbours, **others)


def _squared_distances(position: Float64[Tensor, "R K N d"]) -> Float64[Tensor, "R K N N"]:
    """Between all UAVs, in m², one component at a time."""
    first, *rest = (c.unsqueeze(2) - c.unsqueeze(3) for c in position.unbind(-1))
    squared = first.mul_(first)
    for apart in rest:
        squared.add_(apart.mul_(apart))
    return squared


def _sorted(order: Int64[Tensor, "*s n"]) -> Int64[Tensor, "*s n"]:
    """Ascending along the last axis; numpy's vectorized sort is ten times faster on a CPU."""
    if order.device.type == "cpu":
        return torch.from_numpy(np.sort(order.numpy(), axis=-1))
    return order.sort(-1).values
