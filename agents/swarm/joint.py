"""The joint covariance of a team's positions: of all components, or of one that stands for all.

A UAV's rows are [e, N e]: e = d for all components, e = 1 for one covariance that all axes share;
then a range of weight W informs each axis by W/d, as links in all directions do on average (the
Laplacian of the graph). Fixed UAVs are independent of all others.
"""

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

_MIN_INFORMATION = 1e-10  # m⁻²: keeps the matrix regular for a UAV of which nothing is known


def independent(variance: Float64[Tensor, "B N"], e: int) -> Float64[Tensor, "B N e K"]:
    """The joint covariance of independent UAVs, from their variances (m²)."""
    return torch.diag_embed(variance.repeat_interleave(e, -1)).unflatten(1, (-1, e))


def predict(
    joint: Float64[Tensor, "B N e K"],
    factor: Float64[Tensor, "B N"],
    noise: Float64[Tensor, "B N"],
    fixed: Bool[Tensor, "B N"],
    fix_variance: float,
) -> Float64[Tensor, "B N e K"]:
    """P_ij ← f_i f_j P_ij + δ_ij q_i², with ``factor`` f and process ``noise`` q² (m²); fixed UAVs
    have ``fix_variance`` (m²)."""
    e = joint.shape[2]
    factor = factor.masked_fill(fixed, 0.0)
    factor = factor.repeat_interleave(e, -1)
    after = (factor.unsqueeze(-1) * factor.unsqueeze(-2)) * joint.flatten(1, 2)
    q = noise.masked_fill(fixed, fix_variance).repeat_interleave(e, -1)
    after.diagonal(dim1=-2, dim2=-1).add_(q)
    return after.view_as(joint)


def pair_variance(joint: Float64[Tensor, "B N e K"]) -> Float64[Tensor, "B N N"]:
    """Variance P_ii + P_jj − 2 P_ij (m² per axis) of every vector from UAV to UAV."""
    e = joint.shape[2]
    common = joint.unflatten(-1, (-1, e)).diagonal(dim1=2, dim2=4).mean(-1)
    own = common.diagonal(dim1=-2, dim2=-1)
    return (own.unsqueeze(-1) + own.unsqueeze(-2) - 2 * common).clamp_min(0.0)


def free_indices(fixed: Bool[Tensor, "B N"]) -> Int64[Tensor, "M"]:
    """UAVs that are free in some world: the others need no rows in systems of equations."""
    return (~fixed).any(0).nonzero()[:, 0]


def submatrix(
    joint: Float64[Tensor, "B N e K"], index: Int64[Tensor, "M"]
) -> Float64[Tensor, "B M e L"]:
    """The joint covariance of the UAVs in ``index``."""
    e = joint.shape[2]
    return joint[:, index].unflatten(-1, (-1, e))[..., index, :].flatten(-2)


def embed(
    part: Float64[Tensor, "B M e L"], index: Int64[Tensor, "M"], variance: Float64[Tensor, "B N"]
) -> Float64[Tensor, "B N e K"]:
    """The joint covariance of all, from that of the UAVs in ``index`` and the ``variance`` (m² per
    axis) of the others, which are independent."""
    if len(index) == variance.shape[-1]:
        return part
    e = part.shape[2]
    joint = independent(variance, e)
    rows = (e * index.unsqueeze(-1) + torch.arange(e, device=index.device)).flatten()
    flat, part = joint.flatten(1, 2), part.flatten(1, 2)
    wide = flat[:, rows].scatter(2, rows.expand_as(part), part)
    return flat.index_copy(1, rows, wide).view_as(joint)


def marginals(joint: Float64[Tensor, "B N e K"]) -> Float64[Tensor, "B N e e"]:
    """Each UAV's own block."""
    e = joint.shape[2]
    return joint.unflatten(-1, (-1, e)).diagonal(dim1=1, dim2=3).movedim(-1, 1)


def marginal_variances(joint: Float64[Tensor, "B N e K"]) -> Float64[Tensor, "B N"]:
    """Each UAV's own variance (m² per axis)."""
    return marginals(joint).diagonal(dim1=-2, dim2=-1).mean(-1)


def rescale(
    joint: Float64[Tensor, "B N e K"], variance: Float64[Tensor, "B N"]
) -> Float64[Tensor, "B N e K"]:
    """The same correlations with other variances (m² per axis)."""
    e = joint.shape[2]
    factor = (variance / marginal_variances(joint)).sqrt().repeat_interleave(e, -1)
    scaled = factor.unsqueeze(-1) * factor.unsqueeze(-2) * joint.flatten(1, 2)
    return scaled.view_as(joint)


def precision(
    joint: Float64[Tensor, "B N e K"], fixed: Bool[Tensor, "B N"]
) -> Float64[Tensor, "B K K"]:
    """The precision Λ = P⁻¹ (1/m²) of free UAVs; 0 for the fixed ones."""
    return information_of(joint.flatten(1, 2), fixed.repeat_interleave(joint.shape[2], -1))


def information_of(
    covariance: Float64[Tensor, "B K K"], fixed: Bool[Tensor, "B K"]
) -> Float64[Tensor, "B K K"]:
    """The inverse of a covariance for coordinates that are not ``fixed``; 0 for those that are."""
    covariance = _without(covariance, fixed)
    covariance.diagonal(dim1=-2, dim2=-1).masked_fill_(fixed, 1.0)
    return _without(_inverse(covariance), fixed)


def laplacian(
    weight: Float64[Tensor, "B N N"], index: Int64[Tensor, "M"]
) -> Float64[Tensor, "B M M"]:
    """The rows and columns in ``index`` of Σ_{i<j} W_ij (e_i − e_j)(e_i − e_j)ᵀ."""
    matrix = -weight[:, index.unsqueeze(-1), index]
    matrix.diagonal(dim1=-2, dim2=-1).add_(weight.sum(-1)[:, index])
    return matrix


def posterior(
    information: Float64[Tensor, "B K K"],
    fixed: Bool[Tensor, "B N"],
    variance: Float64[Tensor, "B N"],
) -> Float64[Tensor, "B N e K"]:
    """The joint covariance by the information (1/m²); fixed UAVs have ``variance`` (m²)."""
    e = information.shape[-1] // fixed.shape[-1]
    fixed, variance = (each.repeat_interleave(e, -1) for each in (fixed, variance))
    return covariance_of(information, fixed, variance).unflatten(1, (-1, e))


def covariance_of(
    information: Float64[Tensor, "B K K"],
    fixed: Bool[Tensor, "B K"],
    variance: Float64[Tensor, "B K"],
) -> Float64[Tensor, "B K K"]:
    """The inverse of an information matrix; ``fixed`` coordinates have ``variance`` (m²)."""
    whole = _without(_inverse(pin(information, fixed)), fixed)
    whole.diagonal(dim1=-2, dim2=-1).add_(torch.where(fixed, variance, 0.0))
    return whole


def pin(matrix: Float64[Tensor, "B K K"], fixed: Bool[Tensor, "B K"]) -> Float64[Tensor, "B K K"]:
    """An information matrix whose ``fixed`` coordinates are independent and have 1 m⁻²."""
    matrix = _without(matrix, fixed)
    least = torch.full_like(fixed, _MIN_INFORMATION, dtype=torch.float32).masked_fill(fixed, 1.0)
    matrix.diagonal(dim1=-2, dim2=-1).add_(least)
    return matrix


def _without(
    matrix: Float64[Tensor, "B K K"], fixed: Bool[Tensor, "B K"]
) -> Float64[Tensor, "B K K"]:
    """The matrix with zeros in the rows and columns of ``fixed`` coordinates."""
    rows = matrix.masked_fill(fixed.unsqueeze(-1), 0.0)
    return rows.masked_fill_(fixed.unsqueeze(-2), 0.0)


def _inverse(matrix: Float64[Tensor, "B K K"]) -> Float64[Tensor, "B K K"]:
    return torch.cholesky_inverse(torch.linalg.cholesky_ex(matrix).L)
