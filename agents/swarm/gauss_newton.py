"""Gauss–Newton on a whole team's ranges: the strong reference that keeps every correlation."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.swarm.joint import held
from agents.swarm.links import along_links, lengths

Weigh = Callable[
    [Float64[Tensor, "B N N"]], tuple[Float64[Tensor, "B N N"], Float64[Tensor, "B N N"]]
]


def fisher(
    y: Float64[Tensor, "B N d"],
    weight: Float64[Tensor, "B N N"],
) -> Float64[Tensor, "B N d N d"]:
    """Σ_{i<j} W_ij J_ijᵀ J_ij of distances, J the unit vectors along links: a Laplacian of d × d
    blocks."""
    b, n, d = y.shape
    apart = [c.unsqueeze(2) - c.unsqueeze(1) for c in y.unbind(-1)]
    scale = weight / lengths(y).square()
    matrix = y.new_empty(b, n, d, n, d)
    for p in range(d):
        along = scale * apart[p]
        for q in range(p, d):
            block = along * apart[q]
            part = -block
            part.diagonal(dim1=-2, dim2=-1).add_(block.sum(-1))
            matrix[:, :, p, :, q] = part
            if q != p:
                matrix[:, :, q, :, p] = part
    return matrix


def gauss_newton(
    y: Float64[Tensor, "B N d"],
    distance: Float64[Tensor, "B N N"],
    weigh: Weigh,
    fixed: Bool[Tensor, "B N"],
    prior: Float64[Tensor, "B N d"],
    precision: Float64[Tensor, "B N*d N*d"],
    iterations: int,
) -> tuple[Float64[Tensor, "B N d"], Float64[Tensor, "B N*d N*d"]]:
    """Positions and their joint information, from ranges whose weights (1/m²) and shifts (m)
    ``weigh(residual)`` gives at every iterate, and from a prior with a joint ``precision``. Who is
    ``fixed`` stays (information 1 m⁻², tied to nobody)."""
    n, d = y.shape[1:]
    still = fixed.repeat_interleave(d, -1)
    matrix = precision
    for _ in range(iterations):
        length = lengths(y)
        residual = distance - length
        weight, shift = weigh(residual)
        down = along_links(y, weight * (residual - shift), length).flatten(1)
        down = down + (precision @ (prior - y).flatten(1).unsqueeze(-1))[..., 0]
        matrix = held(fisher(y, weight).flatten(3).flatten(1, 2) + precision, fixed)
        factor = torch.linalg.cholesky_ex(matrix).L
        delta = torch.cholesky_solve(down.masked_fill(still, 0.0).unsqueeze(-1), factor)
        y = y + delta[..., 0].unflatten(-1, (n, d))
    return y, matrix
