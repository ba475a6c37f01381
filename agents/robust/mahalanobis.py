"""Mahalanobis distances in closed form, and the χ² quantiles that they are held against."""

from collections.abc import Sequence
from functools import lru_cache

from jaxtyping import Float
from scipy.special import gammaincinv
from torch import Tensor

from agents.models.measurements import Block


@lru_cache
def chi_square(probability: float, dof: int) -> float:
    """Quantile of the χ² distribution: P⁻¹(k/2, p) · 2, P the regularized incomplete gamma function
    (scipy.stats has it too, but takes a second to import)."""
    return float(2 * gammaincinv(dof / 2, probability))


def whitened_squares(
    residual: Sequence[Float[Tensor, "*#s"]], covariance: Sequence[Sequence[Float[Tensor, "*#s"]]]
) -> list[Float[Tensor, "*s"]]:
    """Terms of rᵀ S⁻¹ r, by elimination (S = L D Lᵀ): term j is that of component j given those
    before it, so that the sum of the last k is the squared distance under S's conditional.

    Components apart: for the few that a measurement has, hundreds of solves become some twenty
    products, and no number depends on how many others are computed beside it.
    """
    return eliminated(residual, covariance)[0]


def eliminated(
    residual: Sequence[Float[Tensor, "*#s"]], covariance: Sequence[Sequence[Float[Tensor, "*#s"]]]
) -> tuple[list[Float[Tensor, "*s"]], list[Float[Tensor, "*s"]]]:
    """``whitened_squares``' terms, and the pivots D, whose product is |S|."""
    r, terms = list(residual), []
    s = [list(row) for row in covariance]
    for j in range(len(r)):
        terms.append(r[j] ** 2 / s[j][j])
        for i in range(j + 1, len(r)):
            factor = s[i][j] / s[j][j]
            r[i] = r[i] - factor * r[j]
            for c in range(j + 1, i + 1):
                s[i][c] = s[i][c] - factor * s[c][j]
    return terms, [s[j][j] for j in range(len(r))]


def mahalanobis_squared(
    block: Block, covariance: Float[Tensor, "B N E E"]
) -> Float[Tensor, "B N m"]:
    """rᵀ (H P Hᵀ + R)⁻¹ r of each measurement's innovation under the prior covariance P."""
    terms = innovation_terms(block, covariance)[0]
    return sum(terms[1:], terms[0])


def innovation_terms(
    block: Block, covariance: Float[Tensor, "B N E E"]
) -> tuple[list[Float[Tensor, "B N m"]], list[Float[Tensor, "B N m"]]]:
    """Of each innovation r and its S = H P Hᵀ + R: k terms whose sum is rᵀ S⁻¹ r, and k numbers
    whose product is |S|."""
    h = block.jacobian
    s = innovation_covariance(h @ covariance.unsqueeze(-3), h, block.total_variance.unbind(-1))
    return eliminated(block.residual.unbind(-1), s)


def innovation_covariance(
    spread: Float[Tensor, "*s k E"],
    h: Float[Tensor, "*#s k E"],
    variances: Sequence[Float[Tensor, "*#s"] | float],
) -> list[list[Float[Tensor, "*s"]]]:
    """The lower triangle of S = H P Hᵀ + R, components apart, from H P (``spread``)."""
    size = range(len(variances))
    s = [[(spread[..., i, :] * h[..., j, :]).sum(-1) for j in range(i + 1)] for i in size]
    for i, noise in enumerate(variances):
        s[i][i] = s[i][i] + noise
    return s
