"""Factors of ranges by expectation propagation (Minka, UAI 2001).

The error of a range is of a mixture, (1 − π) N(0, σ²) + π N(b, s²). Its factor is approximated by a
Gaussian *site* on the length of the link: that with which the cavity, the posterior of the length
without the site, has the moments which it has with the mixture. A site by the responsibility at one
residual (``calibration.weights_and_shifts``) takes that residual for the error; here the doubt
whether a link is NLOS counts as noise.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.layers import sigmoid
from agents.swarm import delays as clocks
from agents.swarm.belief import StepInput
from agents.swarm.delays import Delays
from agents.swarm.links import lengths

DAMPING = 0.7  # share of the new site in its natural parameters
_MIN_WEIGHT = 1e-6  # m⁻²: of a site
_MIN_PRECISION = 1e-9  # m⁻²: of a cavity


@dataclass(frozen=True)
class Sites:
    """Gaussian factors of all ranges: ``weight`` w (1/m²), ``shift`` (m) of the range, and the
    probability that it is NLOS (``outlier``)."""

    weight: Float64[Tensor, "B N N"]
    shift: Float64[Tensor, "B N N"]
    outlier: Float64[Tensor, "B N N"]


@dataclass(frozen=True)
class Cavity:
    """Each link's length without its site: ``residual`` (m) of the range from its mean, and its
    ``variance`` 1/τ (m²)."""

    residual: Float64[Tensor, "B N N"]
    variance: Float64[Tensor, "B N N"]


def cavity(
    residual: Float64[Tensor, "B N N"],
    variance: Float64[Tensor, "B N N"],
    sites: Sites,
) -> Cavity:
    """From the posterior's ``residual`` (m) and ``variance`` v (m²) of each length:
    τ = 1/v − w, and the mean moves by −w (r − shift)/τ."""
    tau = (1 / variance.clamp_min(1e-12) - sites.weight).clamp_min(_MIN_PRECISION)
    moved = sites.weight * (residual - sites.shift) / tau
    return Cavity(residual + moved, 1 / tau)


def sites_by_moments(at: Cavity, inputs: StepInput, std: float, before: Sites | None) -> Sites:
    """The sites with which the cavities have the mixture's moments: weights within 1e-6 m⁻² and
    1/σ², damped towards those ``before``.

    With e the error of the range, z = N(0, 1/τ) the length's: r = z + e. Each component k has
    responsibility ω_k ∝ π_k N(r; b_k, 1/τ + σ_k²) and moments μ_k = (r − b_k) g_k and
    v_k = σ_k² g_k of z, g_k = 1/(1 + τ σ_k²)."""
    (mean_0, mean_1), (clean, other) = (
        part[..., None, None].unbind(1) for part in inputs.error_model.component(std)
    )
    if inputs.confidence is not None:  # a link of several ranges
        count = inputs.confidence.clamp_min(1e-9)
        clean, other = clean / count, other / count
    prior = inputs.outlier_probability
    prior = inputs.error_model.share[:, 1, None, None] if prior is None else prior
    score, moments = [], []
    for bias, noise in ((mean_0, clean), (mean_1, other)):
        total, e = at.variance + noise, at.residual - bias
        score.append(-0.5 * (e.square() / total + total.log()))
        gain = at.variance / total
        moments.append((gain * e, gain * noise))
    outlier = sigmoid(torch.logit(prior) + score[1] - score[0])  # ω_1
    (mu_0, v_0), (mu_1, v_1) = moments
    mu = mu_0 + outlier * (mu_1 - mu_0)
    v = (1 - outlier) * v_0 + outlier * v_1 + outlier * (1 - outlier) * (mu_1 - mu_0).square()
    tau = 1 / at.variance
    weight = (1 / v - tau).clamp_min(_MIN_WEIGHT)
    weight = torch.minimum(weight, 1 / clean)
    natural = mu * (tau + weight)  # w a: with this the mean is μ
    if before is not None:
        # both about the cavity's mean, where the former site is at r − shift
        natural = DAMPING * natural + (1 - DAMPING) * before.weight * (at.residual - before.shift)
        weight = DAMPING * weight + (1 - DAMPING) * before.weight
    mask = inputs.links.mask
    shift = torch.where(mask, at.residual - natural / weight, 0.0)
    return Sites(torch.where(mask, weight, 0.0), shift, outlier)


def length_variance(
    joint: Float64[Tensor, "B N d K"], delays: Delays, y: Float64[Tensor, "B N d"]
) -> Float64[Tensor, "B N N"]:
    """Variance (m²) of each predicted range, along its link: uᵀ (P_ii + P_jj − P_ij − P_ji) u, and
    that of the delays with which it comes."""
    _, n, d = y.shape
    blocks = joint.unflatten(-1, (n, d))  # [B, i, p, j, q]
    own = blocks.diagonal(dim1=1, dim2=3)  # [B, p, q, i]
    length = lengths(y)
    unit = [(c.unsqueeze(2) - c.unsqueeze(1)) / length for c in y.unbind(-1)]
    variance = torch.zeros_like(length)
    for p in range(d):
        for q in range(d):
            between = blocks[:, :, p, :, q]
            apart = own[:, p, q].unsqueeze(-1) + own[:, p, q].unsqueeze(-2) - between - between.mT
            variance = variance + unit[p] * unit[q] * apart
    if delays.common.shape[-1]:
        e = clocks.incidence(y)
        cross = delays.cross.unflatten(-1, (n, 2))  # [B, i, p, j, r]
        mine = torch.einsum("bpri,rij->bijp", cross.diagonal(dim1=1, dim2=3), e)
        theirs = torch.einsum("bipjr,rji->bijp", cross, e)
        along = mine + theirs
        along = along - along.transpose(1, 2)  # covariance of p_i − p_j with the range's delays
        variance = variance + clocks.offset_variance(delays)
        variance = variance + 2 * (along * torch.stack(unit, -1)).sum(-1)
    return variance.clamp_min(0.0)
