"""Calibration: a mixture model of range errors, fitted by EM to links of known length.

Huber's loss cannot remove a bias that has one sign. Between anchors the error of a range is known;
the mixture (1 − π) N(0, σ²) + π N(b, s²) of line-of-sight and NLOS errors is fitted to those errors
by EM, and every other link gets a weight and a shift by the responsibilities at its own residual.
"""

import math

import torch
from jaxtyping import Float64
from tensordict import TensorClass
from torch import Tensor

from agents.layers import sigmoid

MEMORY_STEPS = 20.0  # steps over which errors are averaged, exponentially
_MIN_VARIANCE_SHARE = 0.25  # of the believed variance: no component is narrower
_INITIAL_SHARES = (0.9, 0.1)
_INITIAL_WEIGHT = 5.0  # of the initial model, in links
_SHARES = 21  # grid of π for which the Fisher information is integrated
_ERRORS, _REACH = 81, 6.0  # grid of errors, up to so many standard deviations


class ErrorModel(TensorClass):
    """Per world: sufficient statistics Σ (1, e, e²) of each component's remembered errors; batch
    (B,)."""

    sums: Float64[Tensor, "B 2 3"]

    @property
    def share(self) -> Float64[Tensor, "B 2"]:
        """Shares (1 − π, π) of line-of-sight and NLOS links."""
        return self.sums[..., 0] / self.sums[..., 0].sum(-1, keepdim=True)

    def component(self, std: float) -> tuple[Float64[Tensor, "B 2"], Float64[Tensor, "B 2"]]:
        """Means (0, b) in m and variances (σ², s²) in m²."""
        count, first, second = self.sums.unbind(-1)
        mean = first / count
        mean = torch.stack((torch.zeros_like(mean[:, 0]), mean[:, 1]), -1)
        variance = second / count - mean.square()
        variance[:, 0] = second[:, 0] / count[:, 0]
        return mean, variance.clamp_min(_MIN_VARIANCE_SHARE * std**2)


def prior_model(worlds: int, std: float, device: torch.device) -> ErrorModel:
    """The model before any error: σ = ``std``, b = s = 3 ``std``, π = 0.1."""
    clean = torch.tensor((1.0, 0.0, std**2), dtype=torch.float64)
    other = torch.tensor((1.0, 3 * std, 18 * std**2), dtype=torch.float64)
    sums = torch.stack((_INITIAL_SHARES[0] * clean, _INITIAL_SHARES[1] * other))
    sums = (_INITIAL_WEIGHT * sums).to(device)
    return ErrorModel(sums=sums.expand(worlds, 2, 3).clone(), batch_size=(worlds,))


def log_likelihood_ratio(
    model: ErrorModel,
    error: Float64[Tensor, "B L"],
    length_variance: Float64[Tensor, "B L"],
    std: float,
) -> Float64[Tensor, "B L"]:
    """log N(e; b, s² + v) − log N(e; 0, σ² + v) of an error e (m), v the variance (m²) of the
    length that the range is compared with."""
    score = []
    for mean, variance in zip(
        *(part.unsqueeze(-1).unbind(1) for part in model.component(std)), strict=True
    ):
        total = variance + length_variance
        score.append(-0.5 * ((error - mean).square() / total + total.log()))
    return score[1] - score[0]


def outlier_posterior(
    model: ErrorModel,
    error: Float64[Tensor, "B L"],
    length_variance: Float64[Tensor, "B L"],
    std: float,
    prior: Float64[Tensor, "B #L"] | None = None,
) -> Float64[Tensor, "B L"]:
    """Responsibility of the NLOS component for an error, from a ``prior`` (None: π)."""
    prior = model.share[:, 1:] if prior is None else prior
    return sigmoid(torch.logit(prior) + log_likelihood_ratio(model, error, length_variance, std))


def em_update(
    model: ErrorModel,
    error: Float64[Tensor, "B L"],
    counts: Float64[Tensor, "B L"],
    length_variance: Float64[Tensor, "B L"],
    std: float,
    rounds: int = 3,
) -> ErrorModel:
    """The model after a step's errors (m), each counted ``counts`` times: EM rounds on them and on
    the statistics remembered."""
    initial = prior_model(len(error), std, error.device)
    remembered = model.sums * (1 - 1 / MEMORY_STEPS) + initial.sums / MEMORY_STEPS
    updated = model
    for _ in range(rounds):
        outlier = outlier_posterior(updated, error, length_variance, std)  # E step
        sums = []
        for responsibility, mean, variance in zip(
            ((1 - outlier) * counts, outlier * counts),
            *(part.unsqueeze(-1).unbind(1) for part in updated.component(std)),
            strict=True,
        ):
            gain = variance / (variance + length_variance)
            expected = mean + gain * (error - mean)  # E[e], without the length's own error
            moments = torch.stack(
                (torch.ones_like(expected), expected, expected.square() + gain * length_variance),
                -1,
            )
            sums.append((responsibility.unsqueeze(-2) @ moments)[:, 0])  # M step
        updated = ErrorModel(sums=remembered + torch.stack(sums, 1), batch_size=model.batch_size)
    return updated


def weights_and_shifts(
    model: ErrorModel,
    residual: Float64[Tensor, "B *L"],
    length_variance: Float64[Tensor, "B *L"],
    std: float,
    prior: Float64[Tensor, "B *L"] | None = None,
) -> tuple[Float64[Tensor, "B *L"], Float64[Tensor, "B *L"]]:
    """W = (1 − ω)/σ² + ω/s² (1/m²) and shift ω b / (s² W) (m) of each link: those of the mixture's
    quadratic lower bound at its residual, ω the responsibility of NLOS, from its ``prior``."""
    flat = None if prior is None else prior.flatten(1)
    outlier = outlier_posterior(model, residual.flatten(1), length_variance.flatten(1), std, flat)
    (_, bias), (clean, other) = (part.unsqueeze(-1).unbind(1) for part in model.component(std))
    nlos = outlier / other
    weight = (1 - outlier) / clean + nlos
    return weight.view_as(residual), (nlos * bias / weight).view_as(residual)


def fisher_information(
    model: ErrorModel, prior: Float64[Tensor, "B L"], std: float
) -> Float64[Tensor, "B L"]:
    """∫ p′²/p (1/m²) of a range whose error is NLOS with probability ``prior``: less than the
    weights, as the component is not known. Integrated on a grid of priors and interpolated."""
    mean, variance = (part.unsqueeze(-1) for part in model.component(std))
    reach = _REACH * variance.sqrt()
    low, high = (mean - reach).amin(1), (mean + reach).amax(1)
    grid = torch.linspace(0, 1, _ERRORS, dtype=mean.dtype, device=mean.device)
    error = (low + (high - low) * grid).unsqueeze(1)
    density = torch.exp(-0.5 * (error - mean).square() / variance) / variance.sqrt()
    slope = density * (mean - error) / variance
    share = torch.linspace(0, 1, _SHARES, dtype=mean.dtype, device=mean.device)
    shares = torch.stack((1 - share, share), -1)
    p, dp = shares @ density, shares @ slope  # [B, shares, errors]
    step = (high - low) / (_ERRORS - 1) / math.sqrt(2 * math.pi)
    information = step * (dp.square() / p.clamp_min(1e-300)).sum(-1)
    place = prior * (_SHARES - 1)
    index = place.long().clamp(0, _SHARES - 2)
    part = place - index
    return information.gather(1, index) * (1 - part) + information.gather(1, index + 1) * part
