"""What a team commands for the step k → k + 1: where to go, and whom to exchange with."""

from typing import NamedTuple

from jaxtyping import Float32, Int64
from torch import Tensor

SILENT = -1


class Commands(NamedTuple):
    """``motion``: each UAV's command, m/s or m/s² as the scenario's control says, world frame
    (None: the last one holds). ``calls``, where links are chosen: the UAV that each initiates an
    exchange with, N + m for anchor m, −1 for none; where they are broadcast: any number ≥ 0 to
    speak, −1 to listen (None: nobody calls)."""

    motion: Float32[Tensor, "B N d"] | None = None
    calls: Int64[Tensor, "B N"] | None = None
