"""What ranges' errors look like, learned from links whose length is known.

Huber's loss cannot remove a bias that has one sign. Between anchors the error of a range is known;
two Gaussians, N(0, σ²) and N(b, s²) with share π, are fitted to those errors by EM, and every other
link gets the weight and the shift that its own residual makes likely.
"""

import math

import torch
from jaxtyping import Float64
from tensordict import TensorClass
from torch import Tensor

from agents.layers import sigmoid

FORGET = 20.0  # steps that are remembered
_FLOOR = 0.25  # share of the believed variance below which no component shrinks
_START = (0.9, 0.1)  # shares before anything was seen
_STRENGTH = 5.0  # links' worth of belief in the start
_SHARES = 21  # between 0 and 1, for which the information of an error is worked out
_ERRORS, _REACH = 81, 6.0  # at so many errors, up to so many standard deviations


class ErrorModel(TensorClass):
    """Per world: sums over remembered errors of each component's (1, e, e²), batch (B,)."""

    sums: Float64[Tensor, "B 2 3"]

    @property
    def share(self) -> Float64[Tensor, "B 2"]:
        """How many links are clean, and how many are not."""
        return self.sums[..., 0] / self.sums[..., 0].sum(-1, keepdim=True)

    def component(self, std: float) -> tuple[Float64[Tensor, "B 2"], Float64[Tensor, "B 2"]]:
        """Means (m; that of clean links is 0) and variances (m²)."""
        count, first, second = self.sums.unbind(-1)
        mean = first / count
        mean = torch.stack((torch.zeros_like(mean[:, 0]), mean[:, 1]), -1)
        variance = second / count - mean.square()
        variance[:, 0] = second[:, 0] / count[:, 0]
        return mean, variance.clamp_min(_FLOOR * std**2)


def believed_model(worlds: int, std: float, device: torch.device) -> ErrorModel:
    """Before anything was seen: mostly N(0, std²), some around 3 std with three times the width."""
    clean = torch.tensor((1.0, 0.0, std**2), dtype=torch.float64)
    other = torch.tensor((1.0, 3 * std, 18 * std**2), dtype=torch.float64)
    sums = _STRENGTH * torch.stack((_START[0] * clean, _START[1] * other)).to(device)
    return ErrorModel(sums=sums.expand(worlds, 2, 3).clone(), batch_size=(worlds,))


def outlier_evidence(
    model: ErrorModel,
    error: Float64[Tensor, "B L"],
    added: Float64[Tensor, "B L"] | float,
    std: float,
) -> Float64[Tensor, "B L"]:
    """Log-likelihood of the second component over that of the first, given an error (m) that is
    known but for a variance ``added``."""
    score = []
    for mean, variance in zip(
        *(part.unsqueeze(-1).unbind(1) for part in model.component(std)), strict=True
    ):
        whole = variance + added
        score.append(-0.5 * ((error - mean).square() / whole + whole.log()))
    return score[1] - score[0]


def outlier_probability(
    model: ErrorModel,
    error: Float64[Tensor, "B L"],
    added: Float64[Tensor, "B L"] | float,
    std: float,
    prior: Float64[Tensor, "B #L"] | None = None,
) -> Float64[Tensor, "B L"]:
    """Posterior of the second component, from a ``prior`` (None: its share of all)."""
    share = model.share[:, 1:] if prior is None else prior
    return sigmoid(torch.logit(share) + outlier_evidence(model, error, added, std))


def learned(
    model: ErrorModel,
    error: Float64[Tensor, "B L"],
    counts: Float64[Tensor, "B L"],
    added: Float64[Tensor, "B L"],
    std: float,
    rounds: int = 3,
) -> ErrorModel:
    """The model after a step's errors (m), known but for a variance ``added`` and counted so often
    each: EM rounds on them and on what is remembered."""
    kept = (
        model.sums * (1 - 1 / FORGET) + believed_model(len(error), std, error.device).sums / FORGET
    )
    now = model
    for _ in range(rounds):
        outlier = outlier_probability(now, error, added, std)
        found = []
        for responsible, mean, variance in zip(
            ((1 - outlier) * counts, outlier * counts),
            *(part.unsqueeze(-1).unbind(1) for part in now.component(std)),
            strict=True,
        ):
            part = variance / (variance + added)  # of a deviation that is the error's own
            own = mean + part * (error - mean)
            powers = torch.stack((torch.ones_like(own), own, own.square() + part * added), -1)
            found.append((responsible.unsqueeze(-2) @ powers)[:, 0])
        now = ErrorModel(sums=kept + torch.stack(found, 1), batch_size=model.batch_size)
    return now


def judged(
    model: ErrorModel,
    residual: Float64[Tensor, "B N N"],
    added: Float64[Tensor, "B N N"],
    std: float,
    prior: Float64[Tensor, "B N N"] | None = None,
) -> tuple[Float64[Tensor, "B N N"], Float64[Tensor, "B N N"]]:
    """Each link's weight (1/m²) and the shift (m) that is taken off its range: those of the
    mixture's quadratic lower bound at its residual. ``prior``: probability of the second
    component."""
    told = None if prior is None else prior.flatten(1)
    outlier = outlier_probability(model, residual.flatten(1), added.flatten(1), std, told)
    (_, bias), (clean, other) = (part.unsqueeze(-1).unbind(1) for part in model.component(std))
    heavy = outlier / other
    weight = (1 - outlier) / clean + heavy
    return weight.view_as(residual), (heavy * bias / weight).view_as(residual)


def information(
    model: ErrorModel, prior: Float64[Tensor, "B L"], std: float
) -> Float64[Tensor, "B L"]:
    """Fisher information (1/m²) of a range whose error is the second component's with probability
    ``prior``, ∫ p′²/p: less than ``judged`` weights say, which do not know which of the two it was.
    Worked out for some probabilities, and interpolated."""
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
    known = step * (dp.square() / p.clamp_min(1e-300)).sum(-1)
    place = prior * (_SHARES - 1)
    index = place.long().clamp(0, _SHARES - 2)
    part = place - index
    return known.gather(1, index) * (1 - part) + known.gather(1, index + 1) * part
