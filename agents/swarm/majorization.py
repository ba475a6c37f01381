"""Stress and its majorization (Guttman transform) with anchors and a prior.

S(y) = Σ_{i<j} W_ij (d_ij − ‖y_i − y_j‖)² + Σ_i λ_i ‖y_i − m_i‖² (ST-DCL, equation 19, its window
folded into the prior m). de Leeuw 1977; Costa, Patwari & Hero, ACM TOSN 2006.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from agents.swarm.links import along_links, lengths

RELAXED = 1.9  # ω of steps beyond the majorant's minimum; at 2 they could go on for ever


def stress(
    y: Float64[Tensor, "B N d"],
    distance: Float64[Tensor, "B N N"],
    weight: Float64[Tensor, "B N N"],
    prior: Float64[Tensor, "B N d"],
    trust: Float64[Tensor, "B N"],
) -> Float64[Tensor, "B"]:
    """S(y) in units of ``weight`` · m²; ``trust`` is λ."""
    links = 0.5 * (weight * (distance - lengths(y)) ** 2).sum((-2, -1))
    return links + (trust * (y - prior).square().sum(-1)).sum(-1)


def pull(
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
    trust: Float64[Tensor, "B N"],
) -> Float64[Tensor, "B N d"]:
    """−½ ∂S/∂y."""
    return pull(y, distance, weight) + trust.unsqueeze(-1) * (prior - y)


def majorizer(
    weight: Float64[Tensor, "B N N"],
    trust: Float64[Tensor, "B N"],
    fixed: Bool[Tensor, "B N"],
) -> Float64[Tensor, "B N N"]:
    """Cholesky factor of V, the weighted Laplacian of those that move plus λ (the identity where
    ``fixed``). Who has neither links nor prior stays where it is."""
    moving = ~fixed
    degree = weight.sum(-1) + trust
    v = -weight * (moving.unsqueeze(-1) & moving.unsqueeze(-2))
    alone = degree <= 0
    v.diagonal(dim1=-2, dim2=-1).copy_(torch.where(fixed | alone, 1.0, degree))
    return torch.linalg.cholesky_ex(v).L


def guttman(
    y: Float64[Tensor, "B N d"],
    distance: Float64[Tensor, "B N N"],
    weight: Float64[Tensor, "B N N"],
    prior: Float64[Tensor, "B N d"],
    trust: Float64[Tensor, "B N"],
    fixed: Bool[Tensor, "B N"],
    factor: Float64[Tensor, "B N N"],
) -> Float64[Tensor, "B N d"]:
    """One step y ← y + V⁻¹ (−½ ∂S/∂y), which never raises the stress; anchors stay."""
    down = descent(y, distance, weight, prior, trust)
    down = torch.where(fixed.unsqueeze(-1), 0.0, down)
    return y + torch.cholesky_solve(down, factor)


def own_pull(
    weight: Float64[Tensor, "B N N"], fixed: Bool[Tensor, "B N"]
) -> Float64[Tensor, "B N"]:
    """Σ_j W_ij, once for neighbours that are fixed and twice for those that move as well: a
    diagonal that is no less than V of ``majorizer`` without λ."""
    moving = (~fixed).double().unsqueeze(-1)
    return weight.sum(-1) + (weight @ moving)[..., 0]


def nodewise(
    y: Float64[Tensor, "B N d"],
    distance: Float64[Tensor, "B N N"],
    weight: Float64[Tensor, "B N N"],
    prior: Float64[Tensor, "B N d"],
    trust: Float64[Tensor, "B N"],
    fixed: Bool[Tensor, "B N"],
) -> Float64[Tensor, "B N d"]:
    """One sweep in which every UAV moves by itself, neighbours held, all at once (Jacobi): y_i ←
    y_i + ω (−½ ∂S/∂y_i) / (``own_pull`` + λ_i). It never raises the stress, as ω ≤ 2 (de Leeuw &
    Heiser 1980); anchors stay, and who has neither links nor prior."""
    bound = own_pull(weight, fixed) + trust
    down = descent(y, distance, weight, prior, trust).masked_fill(fixed.unsqueeze(-1), 0.0)
    return y + RELAXED * down / torch.where(bound > 0, bound, 1.0).unsqueeze(-1)


def repeated(
    move: Callable[[Float64[Tensor, "B N d"]], Float64[Tensor, "B N d"]],
    y: Float64[Tensor, "B N d"],
    step: Int64[Tensor, "B N"],
    iterations: int,
    first: int,
) -> Float64[Tensor, "B N d"]:
    """``iterations`` moves, ``first`` in worlds whose first step it is."""
    begins = (step == 0).any(-1)[:, None, None]
    for k in range(first if bool(begins.any()) else iterations):
        y = torch.where(begins | (k < iterations), move(y), y)
    return y


def require_iterations(iterations: int, first: int) -> None:
    """Raise ValueError unless they are counts for ``repeated``."""
    if not 1 <= iterations <= first:
        raise ValueError(
            f"iterations={iterations}, first={first} is not allowed: 1 ≤ iterations ≤ first"
        )
