"""The joint covariance of a team's positions: of all components, or of one that stands for all.

A UAV's rows are [e, N e], e = d for all components and e = 1 for one covariance that every axis
has; then a range of weight W informs each axis by W/d, as links that point everywhere do on average
(a graph's Laplacian). Who is fixed has nothing in common with anybody.
"""

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

_NOTHING = 1e-10  # m⁻²: information on a UAV that nothing is known of


def independent(variance: Float64[Tensor, "B N"], e: int) -> Float64[Tensor, "B N e K"]:
    """That of UAVs with nothing in common, from their variances (m²)."""
    return torch.diag_embed(variance.repeat_interleave(e, -1)).unflatten(1, (-1, e))


def carried(
    joint: Float64[Tensor, "B N e K"],
    kept: Float64[Tensor, "B N"],
    added: Float64[Tensor, "B N"],
    fixed: Bool[Tensor, "B N"],
    spread: float,
) -> Float64[Tensor, "B N e K"]:
    """k_i k_j P_ij with ``added`` (m²) on the diagonal; ``spread`` (m²) there of who is fixed."""
    e = joint.shape[2]
    kept = kept.masked_fill(fixed, 0.0)
    factor = kept.repeat_interleave(e, -1)
    after = (factor.unsqueeze(-1) * factor.unsqueeze(-2)) * joint.flatten(1, 2)
    new = added.masked_fill(fixed, spread).repeat_interleave(e, -1)
    after.diagonal(dim1=-2, dim2=-1).add_(new)
    return after.view_as(joint)


def between(joint: Float64[Tensor, "B N e K"]) -> Float64[Tensor, "B N N"]:
    """Variance (m² per axis) of every vector from UAV to UAV."""
    e = joint.shape[2]
    common = joint.unflatten(-1, (-1, e)).diagonal(dim1=2, dim2=4).mean(-1)
    own = common.diagonal(dim1=-2, dim2=-1)
    return (own.unsqueeze(-1) + own.unsqueeze(-2) - 2 * common).clamp_min(0.0)


def moving(fixed: Bool[Tensor, "B N"]) -> Int64[Tensor, "M"]:
    """Who is not fixed in some world at least: the others need no rows where systems are solved."""
    return (~fixed).any(0).nonzero()[:, 0]


def among(
    joint: Float64[Tensor, "B N e K"], index: Int64[Tensor, "M"]
) -> Float64[Tensor, "B M e L"]:
    """The joint covariance of some."""
    e = joint.shape[2]
    return joint[:, index].unflatten(-1, (-1, e))[..., index, :].flatten(-2)


def whole(
    part: Float64[Tensor, "B M e L"], index: Int64[Tensor, "M"], variance: Float64[Tensor, "B N"]
) -> Float64[Tensor, "B N e K"]:
    """That of all, from that of some and the ``variance`` (m² per axis) of the others."""
    if len(index) == variance.shape[-1]:
        return part
    e = part.shape[2]
    joint = independent(variance, e)
    rows = (e * index.unsqueeze(-1) + torch.arange(e, device=index.device)).flatten()
    flat = joint.flatten(1, 2)
    flat[:, rows.unsqueeze(-1), rows] = part.flatten(1, 2)
    return joint


def own_blocks(joint: Float64[Tensor, "B N e K"]) -> Float64[Tensor, "B N e e"]:
    """Each UAV's own block."""
    e = joint.shape[2]
    return joint.unflatten(-1, (-1, e)).diagonal(dim1=1, dim2=3).movedim(-1, 1)


def variances(joint: Float64[Tensor, "B N e K"]) -> Float64[Tensor, "B N"]:
    """Each UAV's own variance (m² per axis)."""
    return own_blocks(joint).diagonal(dim1=-2, dim2=-1).mean(-1)


def scaled(
    joint: Float64[Tensor, "B N e K"], variance: Float64[Tensor, "B N"]
) -> Float64[Tensor, "B N e K"]:
    """The same correlations with other variances (m² per axis)."""
    e = joint.shape[2]
    factor = (variance / variances(joint)).sqrt().repeat_interleave(e, -1)
    whole = factor.unsqueeze(-1) * factor.unsqueeze(-2) * joint.flatten(1, 2)
    return whole.view_as(joint)


def precision(
    joint: Float64[Tensor, "B N e K"], fixed: Bool[Tensor, "B N"]
) -> Float64[Tensor, "B K K"]:
    """The information (1/m²) that it holds on those who are not fixed; 0 for the others."""
    return held_by(joint.flatten(1, 2), fixed.repeat_interleave(joint.shape[2], -1))


def held_by(
    covariance: Float64[Tensor, "B K K"], still: Bool[Tensor, "B K"]
) -> Float64[Tensor, "B K K"]:
    """The information that a covariance holds on what is not ``still``; 0 on that."""
    tied = _tied(still)
    covariance = covariance.masked_fill(tied, 0.0)
    covariance.diagonal(dim1=-2, dim2=-1).masked_fill_(still, 1.0)
    return _inverse(covariance).masked_fill(tied, 0.0)


def laplacian(
    weight: Float64[Tensor, "B N N"], index: Int64[Tensor, "M"]
) -> Float64[Tensor, "B M M"]:
    """The rows and columns in ``index`` of Σ_{i<j} W_ij (e_i − e_j)(e_i − e_j)ᵀ."""
    rows = weight[:, index]
    matrix = -rows[..., index]
    matrix.diagonal(dim1=-2, dim2=-1).add_(rows.sum(-1))
    return matrix


def posterior(
    information: Float64[Tensor, "B K K"],
    fixed: Bool[Tensor, "B N"],
    variance: Float64[Tensor, "B N"],
) -> Float64[Tensor, "B N e K"]:
    """The joint covariance from all information (1/m²), and the ``variance`` of who is fixed."""
    e = information.shape[-1] // fixed.shape[-1]
    still, known = (each.repeat_interleave(e, -1) for each in (fixed, variance))
    return left_by(information, still, known).unflatten(1, (-1, e))


def left_by(
    information: Float64[Tensor, "B K K"],
    still: Bool[Tensor, "B K"],
    variance: Float64[Tensor, "B K"],
) -> Float64[Tensor, "B K K"]:
    """The covariance that information leaves, and the ``variance`` (m²) of what is ``still``."""
    whole = _inverse(held(information, still)).masked_fill(_tied(still), 0.0)
    whole.diagonal(dim1=-2, dim2=-1).add_(torch.where(still, variance, 0.0))
    return whole


def held(matrix: Float64[Tensor, "B K K"], still: Bool[Tensor, "B K"]) -> Float64[Tensor, "B K K"]:
    """A matrix of information in which what is ``still`` is tied to nothing and has 1 m⁻²."""
    matrix = matrix.masked_fill(_tied(still), 0.0)
    added = torch.full_like(still, _NOTHING, dtype=torch.float32).masked_fill(still, 1.0)
    matrix.diagonal(dim1=-2, dim2=-1).add_(added)
    return matrix


def _tied(still: Bool[Tensor, "B K"]) -> Bool[Tensor, "B K K"]:
    return still.unsqueeze(-1) | still.unsqueeze(-2)


def _inverse(matrix: Float64[Tensor, "B K K"]) -> Float64[Tensor, "B K K"]:
    return torch.cholesky_inverse(torch.linalg.cholesky_ex(matrix).L)
