"""What stands in for the truth where there is none: satellite navigation's fixes as a reference.

For evaluation alone: nothing that estimates ever sees it.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.sensors.base import require

_CEP = math.sqrt(2 * math.log(2))  # a circle of this many standard deviations holds half of all


@dataclass(frozen=True)
class SatelliteReference:
    """Single-point fixes of satellite navigation, one per UAV and step.

    ``cep``: radius in m that holds half of the horizontal errors (1.5 to 2.5 under the open sky:
    ST-DCL paper, section 6.1); vertically the standard deviation is ``vertical`` times that of a
    horizontal axis. ``shared``: the part of the variance that is the same for all UAVs (orbits,
    clocks, atmosphere). Errors are stationary Gauss–Markov processes with time constant ``time`` s.
    """

    cep: float = 2.0
    vertical: float = 1.5
    shared: float = 0.5
    time: float = 60.0

    def __post_init__(self) -> None:
        require(0 <= self.cep < math.inf, self, "cep", "a radius in m ≥ 0")
        require(0 <= self.vertical < math.inf, self, "vertical", "a ratio ≥ 0")
        require(0 <= self.shared <= 1, self, "shared", "a share in [0, 1]")
        require(0 < self.time < math.inf, self, "time", "a time in s > 0")

    def errors(
        self, seeds: Int64[Tensor, "R"], steps: int, n_uavs: int, dim: int, dt: float
    ) -> Float64[np.ndarray, "R K N d"]:
        """Reference minus truth (m), every ``dt`` s, in the worlds of some seeds."""
        keys = noise.fold(noise.row_keys(seeds).unsqueeze(-1), torch.arange(steps))
        drawn = noise.normal(keys, "reference", (n_uavs + 1) * dim)
        white = drawn.double().numpy().reshape(*keys.shape, n_uavs + 1, dim)
        kept = math.exp(-dt / self.time)
        white[:, 1:] *= math.sqrt(1 - kept**2)
        from scipy.signal import lfilter  # takes seconds, and few scenarios need it

        wander = lfilter([1.0], [1.0, -kept], white, axis=1)
        own, common = wander[..., :-1, :], wander[..., -1:, :]
        axes = np.array([1.0, 1.0, self.vertical][:dim]) * self.cep / _CEP
        return axes * (math.sqrt(self.shared) * common + math.sqrt(1 - self.shared) * own)
