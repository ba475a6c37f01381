"""Replay: the truth is a recording."""

from dataclasses import dataclass

import torch
from jaxtyping import Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.series import Series


@dataclass(frozen=True, eq=False)
class RecordedMotion(Motion):
    """Motion from series of T steps, the same for every world; after the last step it stays there.

    ``position`` and ``velocity`` [T, N, d], ``attitude`` [T, N, a] in the frames and units of
    ``Kinematics``, float64; ``valid`` [T, N] marks the steps with truth to score against.
    """

    position: Series
    velocity: Series
    attitude: Series
    valid: Series | None = None

    @property
    def tracked(self) -> bool:
        """Whether there is truth to score against at most steps."""
        return self.valid is None or bool(self.valid.values.float().mean() >= 0.5)

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        length = len(self.position.values)
        shapes = {
            "position": (length, arena.n_uavs, arena.dim),
            "velocity": (length, arena.n_uavs, arena.dim),
            "attitude": (length, arena.n_uavs, 4 if arena.dim == 3 else 1),
        }
        for name, shape in shapes.items():
            series = getattr(self, name).values
            if tuple(series.shape) != shape or series.dtype != torch.float64:
                raise ValueError(
                    f"RecordedMotion: {name} must be float64 of shape {shape}, "
                    f"not {series.dtype} of shape {tuple(series.shape)}"
                )
        return {}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        valid = None if self.valid is None else self.valid.at(steps)
        motion = Kinematics(
            self.position.at(steps), self.velocity.at(steps), self.attitude.at(steps), valid
        )
        return motion, carry
