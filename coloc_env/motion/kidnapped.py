"""Kidnapping: a UAV is put somewhere else from one step to the next, and nothing reports it."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.options import Count, Group, PositiveSeconds


@dataclass(frozen=True)
class Kidnapped(Motion):
    """A motion whose UAVs are found, from step ``at`` on, on the arena's other side.

    Position and velocity are those of the motion turned by half a turn about the arena's vertical
    axis, so they stay in the box; the attitude is kept (gyroscopes measure while a UAV is carried).
    ``uavs``: indices of those that are carried; None: all, and then ranges between them show
    nothing.
    """

    motion: Motion
    at: int
    uavs: tuple[int, ...] | None = None

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        if self.at < 1:
            raise ValueError(f"Kidnapped: at={self.at} is not allowed: a step ≥ 1")
        strangers = [uav for uav in self.uavs or () if not 0 <= uav < arena.n_uavs]
        if strangers or self.uavs == ():
            raise ValueError(f"Kidnapped: uavs={self.uavs} is not allowed: indices of UAVs")
        return self.motion.start(keys, arena)

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        moved, carry = self.motion.advance(carry, steps, arena)
        taken = torch.ones(arena.n_uavs, dtype=torch.bool, device=steps.device)
        if self.uavs is not None:
            taken = torch.zeros_like(taken)
            taken[list(self.uavs)] = True
        steps = steps.unsqueeze(-1)
        away = ((steps >= self.at) & taken).unsqueeze(-1)
        twice = moved.position.new_zeros(arena.dim)
        twice[:2] = 2 * twice.new_tensor(arena.centre[:2])
        sign = torch.ones_like(twice)
        sign[:2] = -1.0
        return Kinematics(
            torch.where(away, twice + sign * moved.position, moved.position),
            torch.where(away, sign * moved.velocity, moved.velocity),
            moved.attitude,
            moved.valid,
            (steps == self.at) & taken,
        ), carry


@dataclass(frozen=True)
class KidnapOptions(Group):
    """At ``kidnap_at`` s (none: never) the UAVs ``kidnapped`` (their numbers; none: all) are put on
    the arena's other side, and nothing reports it to them."""

    title: ClassVar[str] = "kidnapping"

    kidnap_at: PositiveSeconds | None = None
    kidnapped: tuple[Count, ...] | None = None

    def of(self, motion: Motion, dt: float) -> Motion:
        """The motion, with its UAVs kidnapped."""
        if self.kidnap_at is None:
            if self.kidnapped is not None:
                raise ValueError(f"kidnapped={self.kidnapped} is not allowed: only with kidnap_at")
            return motion
        if self.kidnap_at < dt:
            raise ValueError(
                f"kidnap_at={self.kidnap_at} is not allowed: a step's {dt:g} s at least"
            )
        return Kidnapped(motion, round(self.kidnap_at / dt), self.kidnapped)
