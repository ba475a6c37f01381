"""The filter whose covariance the bound is: time and measurement updates of a team's joint errors.

Matrices [T, m, m] of T teams with n UAVs of E errors each, m = n E; what belongs to single UAVs
comes as blocks [T, n, E, E].
"""

import torch
from jaxtyping import Float64
from torch import Tensor


def predict(
    covariance: Float64[Tensor, "T m m"],
    f: Float64[Tensor, "T n E E"],
    q: Float64[Tensor, "T n E E"],
) -> Float64[Tensor, "T m m"]:
    """``F P Fᵀ + Q`` for block-diagonal F and Q; Q may be singular."""
    blocks = f.shape[1:3]
    half = (f @ covariance.unflatten(1, blocks)).flatten(1, 2)
    whole = f @ half.mT.unflatten(1, blocks)
    _diagonal(whole.unflatten(-1, blocks)).add_(q)
    return whole.flatten(1, 2)


def update(
    root: Float64[Tensor, "T m m"],
    own: Float64[Tensor, "T n E E"],
    shared: Float64[Tensor, "T m m"] | None,
) -> Float64[Tensor, "T m m"]:
    """``(P⁻¹ + I)⁻¹`` for P = root rootᵀ (Cholesky) and information I, own and shared."""
    information = add(torch.cholesky_inverse(root), own, shared)
    return torch.cholesky_inverse(torch.linalg.cholesky(information))


def add(
    information: Float64[Tensor, "T m m"],
    own: Float64[Tensor, "T n E E"],
    shared: Float64[Tensor, "T m m"] | None,
) -> Float64[Tensor, "T m m"]:
    """``information`` plus own and shared information, in place."""
    blocks = own.shape[1:3]
    _diagonal(information.unflatten(1, blocks).unflatten(-1, blocks)).add_(own)
    return information if shared is None else information.add_(shared)


def _diagonal(x: Float64[Tensor, "T n E n E"]) -> Float64[Tensor, "T n E E"]:
    """A view of the diagonal blocks."""
    return x.diagonal(dim1=1, dim2=3).movedim(-1, 1)
