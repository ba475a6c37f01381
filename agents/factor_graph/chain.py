"""A chain of states with measurements on each: its MAP estimate, by elimination along the chain.

Between linearized factors the sum of squares of a window of W states is

½‖δ_0 − m_0‖²_P₀ + ½ Σ_k ‖δ_{k+1} − F_k δ_k − d_k‖²_Q_k + ½ Σ_k (δ_kᵀ Λ_k δ_k − 2 η_kᵀ δ_k).

Elimination from the oldest state on is a Kalman filter in information form, and back substitution
the Rauch–Tung–Striebel smoother; iterated about its own outcome that is Gauss–Newton (Bell 1994).
Covariances instead of their inverses let the noise Q be of less than full rank, as that of an IMU
is.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.models.update import posterior


@dataclass(frozen=True)
class Chain:
    """Linearized factors over W states of E error components: of the prior of the oldest one
    (``mean``, ``covariance``), between neighbours in time (``transition`` F, ``offset`` d,
    ``noise`` Q), and of the measurements of each (``precision`` Λ, ``vector`` η)."""

    mean: Float64[Tensor, "*s E"]
    covariance: Float64[Tensor, "*s E E"]
    transition: Float64[Tensor, "*s W-1 E E"]
    offset: Float64[Tensor, "*s W-1 E"]
    noise: Float64[Tensor, "*s W-1 E E"]
    precision: Float64[Tensor, "*s W E E"]
    vector: Float64[Tensor, "*s W E"]


@dataclass(frozen=True)
class Smoothed:
    """The chain's MAP estimate with marginal covariances; ``gain`` C of δ_k | δ_{k+1}; and what is
    known of the second state if the oldest is marginalized out (``next_mean``,
    ``next_covariance``): the prior of a window that starts there."""

    mean: Float64[Tensor, "*s W E"]
    covariance: Float64[Tensor, "*s W E E"]
    gain: Float64[Tensor, "*s W-1 E E"]
    next_mean: Float64[Tensor, "*s E"]
    next_covariance: Float64[Tensor, "*s E E"]

    def joint(self) -> Float64[Tensor, "*s W W E E"]:
        """Covariances of all pairs of states: cov(δ_i, δ_j) = C_i cov(δ_{i+1}, δ_j) for i < j."""
        w = self.mean.shape[-2]
        rows: list[Tensor] = [self.covariance[..., -1:, :, :]]  # row i: cov(δ_i, δ_j), j ≥ i
        for i in range(w - 2, -1, -1):
            later = self.gain[..., i : i + 1, :, :] @ rows[0]
            rows.insert(0, torch.cat((self.covariance[..., i : i + 1, :, :], later), -3))
        whole = torch.stack(
            [torch.nn.functional.pad(row, (0, 0, 0, 0, w - row.shape[-3], 0)) for row in rows], -4
        )
        above = torch.ones(w, w, dtype=torch.bool, device=whole.device).triu()[..., None, None]
        return torch.where(above, whole, whole.transpose(-4, -3).mT)


def smooth(chain: Chain) -> Smoothed:
    """Forward elimination and back substitution."""
    mean, covariance = chain.mean, chain.covariance
    means, covariances, predicted = [], [], [(mean, covariance)]
    w = chain.vector.shape[-2]
    for k in range(w):
        precision, vector = chain.precision[..., k, :, :], chain.vector[..., k, :]
        vector = vector - (precision @ mean.unsqueeze(-1))[..., 0]
        delta, covariance = posterior(covariance, precision, vector)
        mean = mean + delta
        means.append(mean)
        covariances.append(covariance)
        if k < w - 1:
            f = chain.transition[..., k, :, :]
            mean = (f @ mean.unsqueeze(-1))[..., 0] + chain.offset[..., k, :]
            covariance = f @ covariance @ f.mT + chain.noise[..., k, :, :]
            predicted.append((mean, covariance))
    before = torch.stack([p for _, p in predicted], -3)
    filtered = torch.stack(covariances, -3)
    # C = P Fᵀ (P⁻)⁻¹
    gain = torch.linalg.solve(before[..., 1:, :, :], chain.transition @ filtered[..., :-1, :, :]).mT
    for k in range(w - 2, -1, -1):
        c = gain[..., k, :, :]
        ahead = (means[k + 1] - predicted[k + 1][0]).unsqueeze(-1)
        means[k] = means[k] + (c @ ahead)[..., 0]
        covariances[k] = covariances[k] + c @ (covariances[k + 1] - predicted[k + 1][1]) @ c.mT
    second = predicted[min(1, w - 1)]
    return Smoothed(torch.stack(means, -2), torch.stack(covariances, -3), gain, *second)


def diagonal_blocks(
    matrix: Float64[Tensor, "*s N*a N*b"], count: int
) -> Float64[Tensor, "*s N a b"]:
    """The ``count`` blocks on a matrix's diagonal."""
    apart = matrix.unflatten(-1, (count, -1)).unflatten(-3, (count, -1))
    return apart.diagonal(dim1=-4, dim2=-2).movedim(-1, -3)


def block_diagonal(blocks: Float64[Tensor, "*s N a b"]) -> Float64[Tensor, "*s N*a N*b"]:
    """The block-diagonal matrix."""
    n = blocks.shape[-3]
    own = torch.eye(n, dtype=blocks.dtype, device=blocks.device)[:, None, :, None]
    return (blocks.unsqueeze(-2) * own).flatten(-2).flatten(-3, -2)
