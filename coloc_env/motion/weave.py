"""Groups of UAVs that interweave: figures of eight through one point, in both senses."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Box, Carry, Kinematics, Motion
from coloc_env.motion.boxes import assigned, of_each, rooms
from coloc_env.motion.curves import lemniscate
from coloc_env.motion.draws import between, uav_keys, uniform
from coloc_env.motion.fit import at_most, half_extents, inside, interval
from coloc_env.motion.frames import level_flight
from coloc_env.motion.timing import alternating, seconds


@dataclass(frozen=True)
class Weave(Motion):
    """Figures of eight about the centre of a group, through which every UAV passes twice a round.

    Groups of at most ``group`` UAVs, equal to one; UAV i flies in group i modulo their number. A
    group's centre is uniform where all its curves keep the margin from the walls. Speed, half-
    length, phase, the curve's direction and its swing up and down (once a round, with a phase of
    its own) are drawn uniformly per world and UAV. Every second UAV of a group flies its curve
    backwards. Yaw along the velocity. ``boxes``: each group flies in one of these instead of the
    whole arena; which one is drawn in proportion to their volumes.

    The largest acceleration is at most 17/16 speed² / half-length (that of the level curve).
    """

    speed: tuple[float, float] = (0.3, 1.0)  # bound that is nearly met at the crossing, m/s
    half_length: tuple[float, float] | None = None  # m; None: a quarter to half of what fits
    height_amplitude: tuple[float, float] = (0.0, 0.5)  # m
    group: int = 10  # UAVs
    margin: float = 0.5  # m kept from the walls
    boxes: tuple[Box, ...] = ()

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        inside(self, "boxes", self.boxes, arena)
        if self.group < 1:
            raise ValueError(f"Weave: group must be at least one UAV, not {self.group}")
        groups = math.ceil(arena.n_uavs / self.group)
        own, uav = uav_keys(keys, arena.n_uavs), torch.arange(arena.n_uavs, device=keys.device)
        centre, shortest, longest = (
            drawn[..., uav % groups] for drawn in self._groups(own[:, :groups], arena)
        )
        u = uniform(own, "motion.weave", 6).unbind(-1)
        a, swing = between(u[0], shortest, longest), between(u[1], *self._swings(arena))
        delay, turned, phase = 2 * math.pi * u[2], 2 * math.pi * u[3], 2 * math.pi * u[4]
        speed = alternating((uav // groups).double()) * between(u[5], *interval(self, "speed"))
        rate = speed / (2 * a * a + swing * swing).sqrt()
        curve = [a, rate, phase, turned.cos(), turned.sin()]
        upright = [swing * delay.cos(), swing * delay.sin()]
        return {"centre": centre, "curve": torch.stack(curve + upright, 1)}

    def _groups(
        self, keys: Int64[Tensor, "R G"], arena: Arena
    ) -> tuple[Float64[Tensor, "R d G"], Float64[Tensor, "R G"], Float64[Tensor, "R G"]]:
        """Each group's centre, drawn by its first UAV, and the limits of its half-lengths (m)."""
        spaces = rooms(self.boxes, arena)
        room = assigned(spaces, keys)
        extents = tuple(half_extents(self, space, self.margin) for space in spaces)
        swing = self._swings(arena)[1]
        if arena.dim == 3:
            for extent, space in zip(extents, spaces, strict=True):
                at_most(self, "height_amplitude[1]", swing, extent[2], space)
        shortest, longest = of_each(room, map(self._half_length, extents, spaces))
        reach = (longest, longest, swing)
        axes = zip(
            of_each(room, (space.centre for space in spaces)),
            of_each(room, extents),
            reach[: arena.dim],
            uniform(keys, "motion.weave_centre", arena.dim).unbind(-1),
            strict=True,
        )
        centre = [middle + (half - kept) * (2 * u - 1) for middle, half, kept, u in axes]
        return torch.stack(centre, 1), shortest, longest

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        a, rate, phase, c, s, in_phase, in_quadrature = carry["curve"].unsqueeze(2).unbind(1)
        x, y, *z = carry["centre"].unsqueeze(2).unbind(1)
        angle = rate * seconds(steps, arena.dt) + phase
        (along, across), (u, v), (cosine, sine) = lemniscate(angle, rate, a)
        position = [x + (c * along - s * across), y + (s * along + c * across)]
        velocity = [c * u - s * v, s * u + c * v]
        if z:
            swung = in_phase * angle.sin() + in_quadrature * angle.cos()
            position.append(z[0] + swung)
            velocity.append(rate * (in_phase * angle.cos() - in_quadrature * angle.sin()))
        sense = rate.sign()
        ahead = sense * (c * cosine - s * sine), sense * (s * cosine + c * sine)
        return level_flight(position, velocity, ahead, arena.dim), carry

    def _half_length(self, halves: tuple[float, ...], arena: Arena) -> tuple[float, float]:
        widest = min(halves[:2])
        if self.half_length is None:
            return 0.25 * widest, 0.5 * widest
        small, large = interval(self, "half_length")
        return small, at_most(self, "half_length[1]", large, widest, arena)

    def _swings(self, arena: Arena) -> tuple[float, float]:
        return interval(self, "height_amplitude", zero=True) if arena.dim == 3 else (0.0, 0.0)
