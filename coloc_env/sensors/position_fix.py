"""Fixes of a UAV's own position, as satellite navigation gives them."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from coloc_env import noise
from coloc_env.options import Group, Metres, PositiveSeconds, Seconds, Share
from coloc_env.sensors.base import MASK, Layout, Leaf, Sensor, Window, require
from coloc_env.sensors.errors.persistence import held_uniform


@dataclass(frozen=True)
class PositionFix(Sensor):
    """Leaves ``position_fix`` [d] and ``position_fix_mask`` [1]: position in m, world frame, with
    Gaussian noise ``std`` per axis, upwards ``vertical_std`` (none: the same), of the first
    ``count`` UAVs; the others never have one.

    A UAV has no fix for a share ``outage`` of the time, ``outage_time`` s at a stretch (its state,
    fix or none, is redrawn at a mean interval of so long), and none of them has in the times
    ``off`` (from, to) in s. A share ``dropout`` is missing besides.
    """

    std: float = 1.0
    count: int = 1
    vertical_std: float | None = None
    outage: float = 0.0
    outage_time: float = 10.0
    off: tuple[float, float] | None = None
    dropout: float = 0.0

    def __post_init__(self) -> None:
        require(self.std >= 0, self, "std", "a standard deviation in m ≥ 0")
        require(self.count >= 1, self, "count", "at least one UAV (leave the sensor out for 0)")
        upwards = self.vertical_std is None or 0 <= self.vertical_std < math.inf
        require(upwards, self, "vertical_std", "a standard deviation in m ≥ 0")
        for name in ("outage", "dropout"):
            require(0 <= getattr(self, name) <= 1, self, name, "a share in [0, 1]")
        require(0 < self.outage_time < math.inf, self, "outage_time", "a time in s > 0")
        ordered = self.off is None or self.off[0] <= self.off[1]
        require(ordered, self, "off", "(from, to) in s, from ≤ to")

    def axis_std(self, dim: int) -> tuple[float, ...]:
        """Standard deviation (m) of each axis."""
        if dim == 2 or self.vertical_std is None:
            return (self.std,) * dim
        return (self.std, self.std, self.vertical_std)

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {
            "position_fix": Leaf(layout.arena.dim, unit="m", frame="world"),
            "position_fix_mask": Leaf(1, *MASK),
        }

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        position = window.motion.position.to(torch.float32)
        n, dim = position.shape[-2:]
        white = noise.normal(window.keys, "position_fix", n * dim).unflatten(-1, (n, dim))
        uavs = torch.arange(n, device=position.device)
        having = window.alive & (uavs < self.count)
        if self.outage:
            time, first = self.outage_time / window.layout.arena.dt, window.steps[:, 0]
            count = window.steps.shape[1]
            drawn = held_uniform(window.rows, first, count, uavs, "position_fix.outage", time)
            having = having & (drawn >= self.outage)
        if self.off is not None:
            now = window.steps * window.layout.arena.dt
            having = having & ~((now >= self.off[0]) & (now < self.off[1])).unsqueeze(-1)
        if self.dropout:
            missing = noise.uniform(window.keys, "position_fix.dropout", n) < self.dropout
            having = having & ~missing
        mask = having.to(torch.float32).unsqueeze(-1)
        std = white.new_tensor(self.axis_std(dim))
        return {
            "position_fix": (position + std * white) * mask,
            "position_fix_mask": mask,
        }


@dataclass(frozen=True)
class AnchorUavOptions(Group):
    """A share ``anchor_share`` of the UAVs, the first ones, know where they are, to ``anchor_std``
    m per axis, and are not scored."""

    title: ClassVar[str] = "anchor UAVs"

    anchor_share: Share = 0.15
    anchor_std: Metres = 0.1

    def count(self, n_uavs: int) -> int:
        """How many of a team they are."""
        return round(self.anchor_share * n_uavs)

    def fixes(self, n_uavs: int) -> tuple[PositionFix, ...]:
        """The sensor by which they know where they are; nothing if there are none."""
        count = self.count(n_uavs)
        return (PositionFix(self.anchor_std, count),) if count else ()


@dataclass(frozen=True)
class GnssOptions(Group):
    """With ``gnss``, all UAVs have position fixes with noise of ``gnss_std`` m per horizontal axis
    and ``gnss_vertical_std`` m upwards; each has none for a share ``gnss_outage`` of the time,
    ``gnss_outage_time`` s at a stretch, and all of them have none in the times ``gnss_off`` (from,
    to); a share ``gnss_dropout`` is missing besides."""

    title: ClassVar[str] = "satellite navigation"

    gnss: bool = False
    gnss_std: Metres = 1.0
    gnss_vertical_std: Metres = 2.0
    gnss_outage: Share = 0.0
    gnss_outage_time: PositiveSeconds = 10.0
    gnss_off: tuple[Seconds, Seconds] | None = None
    gnss_dropout: Share = 0.0

    def true(self, n_uavs: int) -> tuple[PositionFix, ...]:
        """The sensor as it is; nothing without satellites."""
        outages = (self.gnss_outage, self.gnss_outage_time, self.gnss_off, self.gnss_dropout)
        own = PositionFix(self.gnss_std, n_uavs, self.gnss_vertical_std, *outages)
        return (own,) if self.gnss else ()
