"""Followed motion: UAVs that are where another environment's agents are."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.motion.frames import yaw_attitude


@dataclass(frozen=True, eq=False)
class Followed(Motion):
    """Each UAV is where it is put: the command for the step k → k + 1 is its position at k + 1.

    ``places``: positions [R, N, d] (m, world frame) of the R worlds that are being reset, asked for
    at each reset. The velocity is the mean over the step that ends (0 at first), p' = p + v' dt;
    bodies do not turn: the axes of a body are those of the world.
    """

    steered: ClassVar[bool] = True

    places: Callable[[], Float64[Tensor, "R N d"]]

    @property
    def largest(self) -> float:
        return float("inf")

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        position = self.places().to(torch.float64, copy=True)
        wanted = (len(keys), arena.n_uavs, arena.dim)
        if position.shape != wanted or not bool(position.isfinite().all()):
            raise ValueError(
                f"Followed: places of shape {tuple(position.shape)} do not fit: finite numbers of "
                f"shape {wanted} (worlds, UAVs, axes) are needed"
            )
        return {"position": position, "command": position.clone()}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        position, path = carry["position"], []
        for _ in range(steps.shape[1]):
            moved = carry["command"]
            path.append((moved, (moved - position) / arena.dt))
            position = moved
        places, velocities = (torch.stack(each, 1) for each in zip(*path, strict=True))
        ahead = torch.ones_like(places[..., 0])
        attitude = yaw_attitude(ahead, torch.zeros_like(ahead), arena.dim)
        return Kinematics(places, velocities, attitude), {**carry, "position": position}
