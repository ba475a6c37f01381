"""Stress and its majorization (Guttman transform) with fixed anchors and a prior.

S(y) = Σ_{i<j} W_ij (d_ij − ‖y_i − y_j‖)² + Σ_i λ_i ‖y_i − m_i‖² (ST-DCL, equation 19, its window
folded into the prior m). de Leeuw 1977; Costa, Patwari & Hero, ACM TOSN 2006.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from agents.swarm.links import along_links, lengths

# Over-relaxation ω of steps: the stress never rises for ω ≤ 2, at which they need not converge. The
# diagonal majorants of ``jacobi_step`` and of complete graphs are loose, which allows more than the
# team's own Laplacian, whose weights change between steps.
RELAXATION, TEAM_RELAXATION = 1.9, 1.8


def stress(
    y: Float64[Tensor, "B N d"],
    distance: Float64[Tensor, "B N N"],
    weight: Float64[Tensor, "B N N"],
    prior: Float64[Tensor, "B N d"],
    precision: Float64[Tensor, "B N"],
) -> Float64[Tensor, "B"]:
    """S(y) in units of ``weight`` · m²; ``precision`` is λ (1/m²)."""
    links = 0.5 * (weight * (distance - lengths(y)) ** 2).sum((-2, -1))
    return links + (precision * (y - prior).square().sum(-1)).sum(-1)


def link_descent(
    y: Float64[Tensor, "B N d"],
    distance: Float64[Tensor, "B N N"],
    weight: Float64[Tensor, "B N N"],
) -> Float64[Tensor, "B N d"]:
    """The links' part of −½ ∂S/∂y."""
    length = lengths(y)
    return along_links(y, weight * (distance - length), length)


def descent(
    y: Float64[Tensor, "B N d"],
    distance: Float64[Tensor, "B N N"],
    weight: Float64[Tensor, "B N N"],
    prior: Float64[Tensor, "B N d"],
    precision: Float64[Tensor, "B N"],
) -> Float64[Tensor, "B N d"]:
    """−½ ∂S/∂y."""
    return link_descent(y, distance, weight) + precision.unsqueeze(-1) * (prior - y)


def majorizer(
    weight: Float64[Tensor, "B N N"],
    precision: Float64[Tensor, "B N"],
    fixed: Bool[Tensor, "B N"],
) -> Float64[Tensor, "B N N"]:
    """Cholesky factor of V, the weighted Laplacian of the free UAVs plus λ (the identity at fixed
    ones). A UAV with neither links nor prior stays where it is."""
    free = ~fixed
    degree = weight.sum(-1) + precision
    v = -weight * (free.unsqueeze(-1) & free.unsqueeze(-2))
    isolated = degree <= 0
    v.diagonal(dim1=-2, dim2=-1).copy_(torch.where(fixed | isolated, 1.0, degree))
    return torch.linalg.cholesky_ex(v).L


def guttman_step(
    y: Float64[Tensor, "B N d"],
    distance: Float64[Tensor, "B N N"],
    weight: Float64[Tensor, "B N N"],
    prior: Float64[Tensor, "B N d"],
    precision: Float64[Tensor, "B N"],
    fixed: Bool[Tensor, "B N"],
    factor: Float64[Tensor, "B N N"],
) -> Float64[Tensor, "B N d"]:
    """The Guttman transform y ← y + V⁻¹ (−½ ∂S/∂y), which never raises the stress; anchors stay.
    ``factor``: Cholesky factor of V."""
    step = descent(y, distance, weight, prior, precision)
    step = torch.where(fixed.unsqueeze(-1), 0.0, step)
    return y + torch.cholesky_solve(step, factor)


def jacobi_diagonal(
    weight: Float64[Tensor, "B N N"], fixed: Bool[Tensor, "B N"]
) -> Float64[Tensor, "B N"]:
    """Σ_j W_ij, with free neighbours counted twice: a diagonal matrix that majorizes V of
    ``majorizer`` without λ."""
    free = (~fixed).double().unsqueeze(-1)
    return weight.sum(-1) + (weight @ free)[..., 0]


def jacobi_step(
    y: Float64[Tensor, "B N d"],
    distance: Float64[Tensor, "B N N"],
    weight: Float64[Tensor, "B N N"],
    prior: Float64[Tensor, "B N d"],
    precision: Float64[Tensor, "B N"],
    fixed: Bool[Tensor, "B N"],
) -> Float64[Tensor, "B N d"]:
    """One Jacobi sweep, in which each UAV moves by itself, its neighbours held, all at once:
    y_i ← y_i + ω (−½ ∂S/∂y_i) / (D_i + λ_i), D of ``jacobi_diagonal``. It never raises the stress,
    as ω ≤ 2 (de Leeuw & Heiser 1980). Anchors stay, and UAVs with neither links nor prior."""
    diagonal = jacobi_diagonal(weight, fixed) + precision
    step = descent(y, distance, weight, prior, precision).masked_fill(fixed.unsqueeze(-1), 0.0)
    return y + RELAXATION * step / torch.where(diagonal > 0, diagonal, 1.0).unsqueeze(-1)


def iterate(
    update: Callable[[Float64[Tensor, "B N d"]], Float64[Tensor, "B N d"]],
    y: Float64[Tensor, "B N d"],
    step: Int64[Tensor, "B N"],
    iterations: int,
    first: int,
) -> Float64[Tensor, "B N d"]:
    """``iterations`` updates of y, ``first`` in worlds that are at their first step."""
    first_step = (step == 0).any(-1)[:, None, None]
    for k in range(first if bool(first_step.any()) else iterations):
        y = torch.where(first_step | (k < iterations), update(y), y)
    return y


def require_iterations(iterations: int, first: int) -> None:
    """Raise ValueError unless the first step has as many iterations as the others, or more."""
    if not iterations <= first:
        raise ValueError(
            f"iterations={iterations}, first={first} is not allowed: iterations ≤ first is needed"
        )
