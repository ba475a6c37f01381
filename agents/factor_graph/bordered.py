"""A chain of states together with variables that all of them share, such as a map.

The states' factors form a chain; what landmarks are measured by ties every state to the map, so
that the information matrix is block tridiagonal with a border. Given the errors μ of the map, it is
the chain of ``agents.factor_graph.chain``, whose means are linear in μ: elimination along the chain
carries a mean X u with u = (1, μ), one column for each number, and what is left over is a
quadratic in u, which the map's marginal is read from (Schur's complement, as bundle adjustment has
it: Triggs et al. 2000). No matrix of states and map together is ever solved.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.factor_graph.chain import Chain, Smoothed
from agents.models.update import posterior


@dataclass(frozen=True)
class Shared:
    """A Gaussian of L shared variables' errors μ, and how means of E state errors depend on them:
    a + B μ (``slope`` B)."""

    precision: Float64[Tensor, "*s L L"]
    vector: Float64[Tensor, "*s L"]
    slope: Float64[Tensor, "*s E L"]

    @property
    def mean(self) -> Float64[Tensor, "*s L"]:
        return torch.linalg.solve(self.precision, self.vector)


@dataclass(frozen=True)
class Bordered:
    """A ``chain`` as it is at μ = 0, the ``shared`` variables' prior, with the oldest state's mean
    by them, and of the measurements in each step the information between state and shared ones
    (``border`` Λ_xμ) and about the latter (``precision`` Λ_μμ, ``vector`` η_μ)."""

    chain: Chain
    shared: Shared
    border: Float64[Tensor, "*s W E L"]
    precision: Float64[Tensor, "*s W L L"]
    vector: Float64[Tensor, "*s W L"]


@dataclass(frozen=True)
class Solved:
    """The MAP estimate: ``states`` (their means; covariances given μ), the ``shared`` variables'
    marginal, the states' dependence on them (``slopes``), and the prior of a window that starts at
    the second state: its states are ``states.next_mean`` and ``next_covariance`` (given μ)."""

    states: Smoothed
    shared: Shared
    slopes: Float64[Tensor, "*s W E L"]
    next: Shared


def solve(bordered: Bordered) -> Solved:
    """Forward elimination, the map's marginal, and back substitution."""
    chain, shared = bordered.chain, bordered.shared
    w = chain.vector.shape[-2]
    x = _columns(chain.mean, shared.slope)
    covariance = chain.covariance
    left = _quadratic(shared.precision, shared.vector)  # of u, to be minimized: ½ uᵀ J u
    filtered, covariances, predicted, spreads = [], [], [x], [covariance]
    for k in range(w):
        a = chain.precision[..., k, :, :]
        v = _columns(chain.vector[..., k, :], -bordered.border[..., k, :, :])  # η − Λ_xμ μ = V u
        ahead = v - a @ x
        covariance = posterior(covariance, a, ahead[..., 0])[1]
        about = _quadratic(bordered.precision[..., k, :, :], bordered.vector[..., k, :])
        # J ← J + N − Xᵀ(V − A X) − Vᵀ X − (V − A X)ᵀ C⁺ (V − A X)
        left = left + about - x.mT @ ahead - v.mT @ x - ahead.mT @ covariance @ ahead
        x = x + covariance @ ahead
        filtered.append(x)
        covariances.append(covariance)
        if k == 0:
            after_first = left
        if k < w - 1:
            f = chain.transition[..., k, :, :]
            x = f @ x
            x = _columns(x[..., 0] + chain.offset[..., k, :], x[..., 1:])
            covariance = f @ covariance @ f.mT + chain.noise[..., k, :, :]
            predicted.append(x)
            spreads.append(covariance)
    before = torch.stack(spreads[1:], -3)
    gain = torch.linalg.solve(before, chain.transition @ torch.stack(covariances[:-1], -3)).mT
    for k in range(w - 2, -1, -1):
        c = gain[..., k, :, :]
        filtered[k] = filtered[k] + c @ (filtered[k + 1] - predicted[k + 1])
        covariances[k] = covariances[k] + c @ (covariances[k + 1] - spreads[k + 1]) @ c.mT
    found, second = torch.stack(filtered, -3), predicted[min(1, w - 1)]
    whole = _shared(left, found[..., -1, :, 1:])
    onward = _shared(after_first, second[..., 1:])
    states = Smoothed(
        found[..., 0] + (found[..., 1:] @ whole.mean[..., None, :, None])[..., 0],
        torch.stack(covariances, -3),
        gain,
        second[..., 0] + (onward.slope @ onward.mean.unsqueeze(-1))[..., 0],
        spreads[min(1, w - 1)],
    )
    return Solved(states, whole, found[..., 1:], onward)


def _columns(
    mean: Float64[Tensor, "*s E"], slope: Float64[Tensor, "*s E L"]
) -> Float64[Tensor, "*s E U"]:
    """X of a mean X u, u = (1, μ)."""
    return torch.cat((mean.unsqueeze(-1), slope), -1)


def _quadratic(
    precision: Float64[Tensor, "*s L L"], vector: Float64[Tensor, "*s L"]
) -> Float64[Tensor, "*s U U"]:
    """J of ½ uᵀ J u = ½ μᵀ Λ μ − ηᵀ μ."""
    padded = torch.nn.functional.pad(precision, (1, 0, 1, 0))
    padded[..., 0, 1:] = padded[..., 1:, 0] = -vector
    return padded


def _shared(quadratic: Float64[Tensor, "*s U U"], slope: Float64[Tensor, "*s E L"]) -> Shared:
    precision = quadratic[..., 1:, 1:]
    return Shared(0.5 * (precision + precision.mT), -quadratic[..., 1:, 0], slope)
