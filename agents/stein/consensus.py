"""Relaxed ADMM between the holders of a team's poses (CSPF paper, equations 7 and 21).

For each edge and agent a holder keeps one dual variable c = −z/γ, a group element, z the Lagrange
multiplier and γ the penalty, and sends it to the other end. Equation 21 as printed has the wrong
sign in its last line: from equations 7 and 30 follows z⁺ = z − η((z_i + z_r)/2 + γ x).
"""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.stein.estimate import States
from coloc_env.geometry import Poses, Pulls


def penalty_steps(
    poses: type[Poses],
    x: Float64[Tensor, "B H N m P"],
    received: Float64[Tensor, "B H R N P"],
    active: Bool[Tensor, "B H R"],
) -> Pulls:
    """Σ_r log(x_j⁻¹ c[r, h, j]) over ``active`` edges: each particle's steps to the dual variables
    ``received`` from their other ends, the gradient of the penalty γ/2 ‖x + z/γ‖² over −γ
    (equation 21, line 2); and the sums of their squares."""
    heard = torch.where(active[..., None, None], received, poses.identity(x))
    weight = active.to(x.dtype).unsqueeze(2).expand(-1, -1, x.shape[2], -1)
    return poses.pulls(x, heard.transpose(2, 3).contiguous(), weight)


def dual_update(
    poses: States,
    own: Float64[Tensor, "B H R N P"],
    received: Float64[Tensor, "B H R N P"],
    estimate: Float64[Tensor, "B H N P"],
    rate: float,
) -> Float64[Tensor, "B H R N P"]:
    """c_h ← c_h exp(η [log(c_h⁻¹ x̂_h) − ½ log(c_h⁻¹ c_r)]), η the ``rate`` (equation 21, line 3,
    with the sign corrected)."""
    targets = torch.stack((estimate.unsqueeze(2).expand_as(received), received))
    to_estimate, to_other = poses.minus(targets, own).unbind(0)
    return poses.plus(own, rate * (to_estimate - 0.5 * to_other))
