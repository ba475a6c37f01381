"""Relaxed ADMM between the holders of a team's poses (CSPF paper, eqs. 7 and 21).

For each edge and agent a holder keeps one group element c = −z/γ, z the Lagrange multiplier, and
tells it to the other end. Eq. 21 as printed has the wrong sign in its last line: from eqs. 7 and 30
follows z⁺ = z − η((z_i + z_r)/2 + γ x).
"""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from coloc_env.geometry import Poses


def pulls(
    poses: type[Poses],
    x: Float64[Tensor, "B H N m P"],
    told: Float64[Tensor, "B H R N P"],
    active: Bool[Tensor, "B H R"],
) -> Float64[Tensor, "B H R N m D"]:
    """log(x_j⁻¹ c[r, h, j]): where the other ends' variables, ``told``, pull each particle."""
    toward = poses.minus(told.unsqueeze(-2), x.unsqueeze(2))
    return torch.where(active[..., None, None, None], toward, 0.0)


def agreed(
    poses: type[Poses],
    own: Float64[Tensor, "B H R N P"],
    told: Float64[Tensor, "B H R N P"],
    estimate: Float64[Tensor, "B H N P"],
    rate: float,
) -> Float64[Tensor, "B H R N P"]:
    """c_h ← c_h exp(η [log(c_h⁻¹ x̂_h) − ½ log(c_h⁻¹ c_r)])."""
    toward = torch.stack((estimate.unsqueeze(2).expand_as(told), told))
    here, there = poses.minus(toward, own).unbind(0)
    return poses.plus(own, rate * (here - 0.5 * there))
