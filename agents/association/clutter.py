"""What a landmark vector without a name says of a state: any landmark may be seen, or clutter."""

import math

from jaxtyping import Float
from torch import Tensor

from coloc_env.sensors import UnlabelledLandmarks

CLUTTER = 0.05  # share ε of measurements that say nothing of the state


def reach_volume(sensor: UnlabelledLandmarks, dim: int) -> float:
    """V in m³ (m² in the plane) within which a landmark is seen, and clutter lies anywhere."""
    radius = sensor.labelled.radius
    return math.pi * radius**2 if dim == 2 else 4 / 3 * math.pi * radius**3


def log_mixture(each: Float[Tensor, "*s L"], volume: float, dim: int = -1) -> Float[Tensor, "*s"]:
    """log p(z) = log(ε / V + (1 − ε) / L · Σ_l p(z | l)) from the log p(z | l) of the L landmarks
    of the map along ``dim``."""
    seen = (1 - CLUTTER) / each.shape[dim] * each.exp().sum(dim)
    return (CLUTTER / volume + seen).log()
