"""Relative poses from the ranges between two arrays of antennas, by robust least squares."""

import math

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from coloc_env.geometry import Se3, concat, cross_matrix, quaternion_matrix

_HEADINGS = 4  # of the other array that Gauss–Newton starts from
_ROUNDS = (5, 10)  # of Gauss–Newton from all of them, and from the best
_CAUCHY = 2.4  # standard deviations at which a range counts half as much (95 % efficient)


def relative_poses(
    ranges: Float64[Tensor, "K I J"],
    there: Bool[Tensor, "K I J"],
    arms: tuple[Float64[Tensor, "I 3"], Float64[Tensor, "J 3"]],
    std: Float64[Tensor, "K"],
    above: Float64[Tensor, "K"],
    above_std: float,
    tilt_std: float,
) -> tuple[Float64[Tensor, "K 7"], Float64[Tensor, "K 6 6"]]:
    """Poses T of one array (second ``arms``) in the body frame of another (first), and their
    covariances in the tangent [ρ, φ] at T, from K sets of ranges r_ij = ‖T b_j − a_i‖ + noise.

    Arrays in the plane z = 0 of their bodies do not show which side of that plane the other is on:
    T and its mirror image M T M, M = diag(1, 1, −1), have the very same ranges; and of an array
    near the plane, neither its height nor how both are tilted shows. So two things more are given:
    how far ``above`` the first the second is (m, with ``above_std``), and that both are level
    within ``tilt_std`` rad. Ranges that do not fit count less (Cauchy's weights, ``std`` in m).

    Gauss–Newton starts in the direction that the ranges of each array's antennas differ in, and at
    four headings about the one that they suggest; the pose that fits best is returned.
    """
    own, other = arms
    given = ranges, there, own, other, std, above, above_std, tilt_std
    start = _starts(ranges, there, own, other, above)
    found = [_descended(pose, given, _ROUNDS[0]) for pose in start.unbind(1)]
    costs = torch.stack([_normal_equations(pose, *given)[2] for pose in found])
    best = costs.argmin(0).view(1, -1, 1).expand(1, -1, 7)
    pose = _descended(torch.stack(found).gather(0, best)[0], given, _ROUNDS[1])
    return pose, torch.linalg.inv(_normal_equations(pose, *given)[0])


def _descended(pose: Float64[Tensor, "K 7"], given: tuple, rounds: int) -> Float64[Tensor, "K 7"]:
    """The pose after some Gauss–Newton steps."""
    for _ in range(rounds):
        information, gradient, _ = _normal_equations(pose, *given)
        pose = Se3.plus(pose, torch.linalg.solve(information, gradient.unsqueeze(-1))[..., 0])
    return pose


def _normal_equations(
    pose: Float64[Tensor, "K 7"],
    ranges: Float64[Tensor, "K I J"],
    there: Bool[Tensor, "K I J"],
    own: Float64[Tensor, "I 3"],
    other: Float64[Tensor, "J 3"],
    std: Float64[Tensor, "K"],
    above: Float64[Tensor, "K"],
    above_std: float,
    tilt_std: float,
) -> tuple[Float64[Tensor, "K 6 6"], Float64[Tensor, "K 6"], Float64[Tensor, "K"]]:
    """Σ w JᵀJ, Σ w Jᵀ residual, and the cost, by right perturbations of the pose."""
    rotation = quaternion_matrix(pose[:, 3:])
    apart = Se3.act(pose.unsqueeze(1), other).unsqueeze(1) - own.unsqueeze(1)  # [K, I, J, 3]
    length = torch.linalg.vector_norm(apart, dim=-1).clamp_min(1e-6)
    along = (apart / length.unsqueeze(-1)) @ rotation.unsqueeze(1)  # in the other's body frame
    turning = torch.cross(other.expand_as(along), along, dim=-1)
    jacobian = torch.cat((along, turning), -1)
    std = std[:, None, None]
    residual = (ranges - length) / std
    squared = (residual / _CAUCHY).square()
    weight = torch.where(there, 1 / (1 + squared), 0.0)
    residual = torch.where(there, residual, 0.0)
    cost = torch.where(there, _CAUCHY**2 * squared.log1p(), 0.0).sum((1, 2))
    flat = (jacobian / std.unsqueeze(-1)).flatten(1, 2)
    weighted = flat * weight.flatten(1).unsqueeze(-1)
    information = weighted.mT @ flat
    gradient = (weighted.mT @ residual.flatten(1).unsqueeze(-1))[..., 0]
    # Given beside the ranges: the height, and where the other's z axis points, R e_z = e_z.
    axis = pose.new_tensor((0.0, 0.0, 1.0))
    raised = concat((rotation[:, 2], torch.zeros_like(rotation[:, 2]))).unsqueeze(1) / above_std
    tilted = (-rotation @ cross_matrix(axis))[:, :2] / tilt_std
    more = torch.cat((raised, torch.cat((torch.zeros_like(tilted), tilted), -1)), 1)
    lacking = torch.cat(
        ((above - pose[:, 2]).unsqueeze(-1) / above_std, -rotation[:, :2, 2] / tilt_std), -1
    )
    information = information + more.mT @ more
    gradient = gradient + (more.mT @ lacking.unsqueeze(-1))[..., 0]
    return information, gradient, cost + lacking.square().sum(-1)


def _starts(
    ranges: Float64[Tensor, "K I J"],
    there: Bool[Tensor, "K I J"],
    own: Float64[Tensor, "I 3"],
    other: Float64[Tensor, "J 3"],
    above: Float64[Tensor, "K"],
) -> Float64[Tensor, "K S 7"]:
    """Level poses in the direction in which the ranges of an array's antennas fall."""
    missing = ranges.masked_fill(~there, torch.nan)
    middle = missing.flatten(1).nanmedian(-1).values

    def bearing(of_antenna: Float64[Tensor, "K I"], arm: Float64[Tensor, "I 3"]) -> Tensor:
        fall = torch.where(of_antenna.isnan(), 0.0, middle.unsqueeze(-1) - of_antenna)
        direction = fall @ arm[:, :2]
        return torch.atan2(direction[:, 1], direction[:, 0])

    seen = bearing(missing.nanmedian(2).values, own)
    back = bearing(missing.nanmedian(1).values, other)
    flat = (middle.square() - above.square()).clamp_min(0.01).sqrt()
    heading = (seen - back + math.pi).unsqueeze(-1)
    heading = heading + torch.arange(_HEADINGS, dtype=torch.float32) * (2 * math.pi / _HEADINGS)
    position = torch.stack((flat * seen.cos(), flat * seen.sin(), above), -1)
    zero = torch.zeros_like(heading)
    attitude = torch.stack(((0.5 * heading).cos(), zero, zero, (0.5 * heading).sin()), -1)
    return torch.cat((position.unsqueeze(1).expand(-1, _HEADINGS, -1), attitude), -1)
