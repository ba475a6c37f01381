"""What a task keeps from step to step: the estimator's belief, and what it says."""

from typing import Any

from jaxtyping import Bool, Float, Float32, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.localizer import Estimate


class TaskMemory(TensorClass):
    """The estimator's belief, and what it says at the step last observed (m, m/s; world frame).

    ``joint`` [B, N, N, d, d]: covariances (m²) between all UAVs' positions, 0 where the estimator
    keeps none. ``seen``: whom each ranged to in the step, UAVs, then anchors. ``more``: what a task
    keeps beside.
    """

    belief: Any
    action: Float32[Tensor, "B N A"]
    position: Float[Tensor, "B N d"]
    velocity: Float[Tensor, "B N d"]
    joint: Float[Tensor, "B N N d d"]
    seen: Bool[Tensor, "B N M"]
    step: Int64[Tensor, "B N"]
    more: Any


def joint_covariance(belief: Any, estimate: Estimate) -> Float[Tensor, "B N N d d"]:
    """Covariances between all positions: a joint filter's, or each UAV's own on the diagonal."""
    own = estimate.covariance
    b, n, d = own.shape[:3]
    whole = getattr(belief, "covariance", None)
    if n > 1 and whole is not None and whole.shape[-1] == n * whole.shape[-2]:
        return whole.unflatten(-1, (n, -1))[:, :, :d, :, :d].transpose(2, 3)
    joint = own.new_zeros(b, n, n, d, d)
    joint.diagonal(dim1=1, dim2=2).copy_(own.movedim(1, -1))
    return joint


def own_covariance(joint: Float[Tensor, "B N N d d"]) -> Float[Tensor, "B N d d"]:
    """Each UAV's own covariance (m²)."""
    return joint.diagonal(dim1=1, dim2=2).movedim(-1, 1)


def own_sigma(joint: Float[Tensor, "B N N d d"]) -> Float[Tensor, "B N"]:
    """Root of each UAV's mean variance per axis (m)."""
    own = joint.diagonal(dim1=1, dim2=2).diagonal(dim1=1, dim2=2)  # [B, N, d]
    return own.mean(-1).clamp_min(0.0).sqrt()


def total_sigma(joint: Float[Tensor, "B N N d d"]) -> Float[Tensor, "B N"]:
    """Root of each UAV's variance, all axes together (m): of its distance from the truth."""
    return own_sigma(joint) * joint.shape[-1] ** 0.5
