"""Gauss–Newton on a whole team's ranges: the strong reference that keeps every correlation."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.swarm import delays
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
    precision: Float64[Tensor, "B K K"],
    iterations: int,
) -> tuple[Float64[Tensor, "B N d"], Float64[Tensor, "B N 2"], Float64[Tensor, "B K K"]]:
    """Positions, the delays (m) that ranges have beyond what is taken off already, and the joint
    information on both (K = N d + 2 N), from ranges whose weights (1/m²) and shifts (m)
    ``weigh(residual)`` gives at every iterate, and from a prior with a joint ``precision``. Where
    that is of positions alone (K = N d) there are no delays. Who is ``fixed`` stays (information
    1 m⁻², tied to nobody)."""
    n, d = y.shape[1:]
    late = y.new_zeros(*y.shape[:2], 2)
    delayed = precision.shape[-1] > n * d
    still = coordinates(fixed, d, precision.shape[-1])
    matrix = precision
    for _ in range(iterations):
        length = lengths(y)
        residual = distance - length
        if delayed:
            residual = residual - delays.added(late)
        weight, shift = weigh(residual)
        strength = weight * (residual - shift)
        down, off = along_links(y, strength, length).flatten(1), (prior - y).flatten(1)
        if delayed:
            push = torch.einsum("bij,rij->bir", strength, delays.ends(y))
            down, off = (
                torch.cat((down, push.flatten(1)), -1),
                torch.cat((off, -late.flatten(1)), -1),
            )
        down = down + (precision @ off.unsqueeze(-1))[..., 0]
        matrix = held(informed(y, weight, delayed) + precision, still)
        factor = torch.linalg.cholesky_ex(matrix).L
        delta = torch.cholesky_solve(down.masked_fill(still, 0.0).unsqueeze(-1), factor)[..., 0]
        y = y + delta[:, : n * d].unflatten(-1, (n, d))
        if delayed:
            late = late + delta[:, n * d :].unflatten(-1, (n, 2))
    return y, late, matrix


def informed(
    y: Float64[Tensor, "B N d"], weight: Float64[Tensor, "B N N"], delayed: bool
) -> Float64[Tensor, "B K K"]:
    """The information (1/m²) of ranges on positions and, if they are ``delayed``, on delays."""
    matrix = fisher(y, weight).flatten(3).flatten(1, 2)
    if not delayed:
        return matrix
    unit = (y.unsqueeze(2) - y.unsqueeze(1)) / lengths(y).unsqueeze(-1)
    cross, common = delays.information(weight, unit)
    return torch.cat((torch.cat((matrix, cross), -1), torch.cat((cross.mT, common), -1)), -2)


def coordinates(fixed: Bool[Tensor, "B N"], d: int, size: int) -> Bool[Tensor, "B K"]:
    """Which of ``size`` unknowns, positions first, are coordinates of who is fixed."""
    still = fixed.repeat_interleave(d, -1)
    return torch.nn.functional.pad(still, (0, size - still.shape[-1]))
