"""Gauss–Newton on a whole team's ranges, with all correlations."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.swarm import delays
from agents.swarm.joint import pin
from agents.swarm.links import along_links, lengths

WeightFunction = Callable[
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
    weights: WeightFunction,
    fixed: Bool[Tensor, "B N"],
    prior: Float64[Tensor, "B N d"],
    precision: Float64[Tensor, "B K K"],
    iterations: int,
) -> tuple[Float64[Tensor, "B N d"], Float64[Tensor, "B N 2"], Float64[Tensor, "B K K"]]:
    """Positions, the delays (m) left in ranges, and the joint information on both
    (K = N d + 2 N): x ← x + (Jᵀ W J + Λ)⁻¹ (Jᵀ W r + Λ (m − x)).

    ``weights(residual)`` gives weights W (1/m²) and shifts (m) at every iterate; the ``prior`` m
    has the joint ``precision`` Λ. Where that is of positions alone (K = N d) there are no delays.
    Fixed UAVs stay (independent, information 1 m⁻²)."""
    n, d = y.shape[1:]
    delay = y.new_zeros(*y.shape[:2], 2)
    delayed = precision.shape[-1] > n * d
    pinned = fixed_coordinates(fixed, d, precision.shape[-1])
    matrix = precision
    for _ in range(iterations):
        length = lengths(y)
        residual = distance - length
        if delayed:
            residual = residual - delays.offsets(delay)
        weight, shift = weights(residual)
        strength = weight * (residual - shift)
        gradient = along_links(y, strength, length).flatten(1)  # Jᵀ W r
        to_prior = (prior - y).flatten(1)
        if delayed:
            by_delay = torch.einsum("bij,rij->bir", strength, delays.incidence(y))
            gradient = torch.cat((gradient, by_delay.flatten(1)), -1)
            to_prior = torch.cat((to_prior, -delay.flatten(1)), -1)
        gradient = gradient + (precision @ to_prior.unsqueeze(-1))[..., 0]
        matrix = pin(information_matrix(y, weight, delayed) + precision, pinned)
        factor = torch.linalg.cholesky_ex(matrix).L
        gradient = gradient.masked_fill(pinned, 0.0).unsqueeze(-1)
        delta = torch.cholesky_solve(gradient, factor)[..., 0]
        y = y + delta[:, : n * d].unflatten(-1, (n, d))
        if delayed:
            delay = delay + delta[:, n * d :].unflatten(-1, (n, 2))
    return y, delay, matrix


def information_matrix(
    y: Float64[Tensor, "B N d"], weight: Float64[Tensor, "B N N"], delayed: bool
) -> Float64[Tensor, "B K K"]:
    """The information Jᵀ W J (1/m²) of ranges on positions and, if ``delayed``, on delays."""
    matrix = fisher(y, weight).flatten(3).flatten(1, 2)
    if not delayed:
        return matrix
    unit = (y.unsqueeze(2) - y.unsqueeze(1)) / lengths(y).unsqueeze(-1)
    cross, common = delays.information(weight, unit)
    return torch.cat((torch.cat((matrix, cross), -1), torch.cat((cross.mT, common), -1)), -2)


def fixed_coordinates(fixed: Bool[Tensor, "B N"], d: int, size: int) -> Bool[Tensor, "B K"]:
    """Which of ``size`` unknowns, positions first, are coordinates of fixed UAVs."""
    pinned = fixed.repeat_interleave(d, -1)
    return torch.nn.functional.pad(pinned, (0, size - pinned.shape[-1]))
