"""What ranges' errors look like, learned from links whose length is known.

Huber's loss cannot remove a bias that has one sign. Between anchors the error of a range is known;
two Gaussians, N(0, σ²) and N(b, s²) with share π, are fitted to those errors by EM, and every other
link gets the weight and the shift that its own residual makes likely.
"""

import torch
from jaxtyping import Bool, Float64
from tensordict import TensorClass
from torch import Tensor

from agents.layers import sigmoid

FORGET = 20.0  # steps that are remembered
_FLOOR = 0.25  # share of the believed variance below which no component shrinks
_START = (0.9, 0.1)  # shares before anything was seen
_STRENGTH = 5.0  # links' worth of belief in the start


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


def outlier_probability(
    model: ErrorModel,
    error: Float64[Tensor, "B L"],
    added: Float64[Tensor, "B L"] | float,
    std: float,
) -> Float64[Tensor, "B L"]:
    """Posterior of the second component given an error (m) that is known but for a variance
    ``added``."""
    score = []
    for mean, variance, share in zip(
        *(part.unsqueeze(-1).unbind(1) for part in (*model.component(std), model.share)),
        strict=True,
    ):
        whole = variance + added
        score.append(share.log() - 0.5 * ((error - mean).square() / whole + whole.log()))
    return sigmoid(score[1] - score[0])


def learned(
    model: ErrorModel,
    error: Float64[Tensor, "B L"],
    mask: Bool[Tensor, "B L"],
    std: float,
    rounds: int = 3,
) -> ErrorModel:
    """The model after a step's known errors: EM rounds on them and on what is remembered."""
    kept = (
        model.sums * (1 - 1 / FORGET) + believed_model(len(error), std, error.device).sums / FORGET
    )
    powers = torch.stack((torch.ones_like(error), error, error.square()), -1)
    now, counts = model, mask.double()
    for _ in range(rounds):
        outlier = outlier_probability(now, error, 0.0, std)
        found = torch.stack(((1 - outlier) * counts, outlier * counts), 1)
        now = ErrorModel(sums=kept + found @ powers, batch_size=model.batch_size)
    return now


def judged(
    model: ErrorModel,
    residual: Float64[Tensor, "B N N"],
    added: Float64[Tensor, "B N N"],
    std: float,
) -> tuple[Float64[Tensor, "B N N"], Float64[Tensor, "B N N"]]:
    """Each link's weight (1/m²) and the shift (m) that is taken off its range: those of the
    mixture's quadratic lower bound at its residual."""
    outlier = outlier_probability(model, residual.flatten(1), added.flatten(1), std)
    (_, bias), (clean, other) = (part.unsqueeze(-1).unbind(1) for part in model.component(std))
    heavy = outlier / other
    weight = (1 - outlier) / clean + heavy
    return weight.view_as(residual), (heavy * bias / weight).view_as(residual)
