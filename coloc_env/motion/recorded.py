"""Replay: the truth is a tape."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion


@dataclass(frozen=True, eq=False)
class Recorded(Motion):
    """Motion from tapes of T steps, the same for every world; after the last step it stays there.

    The tapes' frames and units are those of ``Kinematics``. They must lie on the worlds' device.
    """

    position: Float64[Tensor, "T N d"]
    velocity: Float64[Tensor, "T N d"]
    attitude: Float64[Tensor, "T N a"]

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        length = len(self.position)
        shapes = {
            "position": (length, arena.n_uavs, arena.dim),
            "velocity": (length, arena.n_uavs, arena.dim),
            "attitude": (length, arena.n_uavs, 4 if arena.dim == 3 else 1),
        }
        for name, shape in shapes.items():
            tape = getattr(self, name)
            found = (tuple(tape.shape), tape.dtype, tape.device)
            if found != (shape, torch.float64, keys.device):
                raise ValueError(
                    f"Recorded: {name} must be float64 of shape {shape} on {keys.device}, "
                    f"not {found[1]} of shape {found[0]} on {found[2]}"
                )
        return {}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        index = steps.clamp(max=len(self.position) - 1)
        return Kinematics(self.position[index], self.velocity[index], self.attitude[index]), carry
