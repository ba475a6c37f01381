"""Kinds of feedback from the graph network to the optimizer (ST-DCL paper, section 4.2.3)."""

import math
from typing import Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.stdcl.network import Correction
from agents.swarm.belief import Solution, StepInput
from agents.swarm.links import lengths

FeedbackKind = Literal["none", "paper", "links", "positions", "learned"]
_MOST = 0.1  # of a confidence in a step: the paper's 10 %
_MAX_RATE = math.log(1 + _MOST)  # the same as a logarithm
_C_MIN = 0.1  # smallest confidence of a link
KAPPA = 0.02  # κ of equation 36: up to 5 σ a link loses less than 10 %


class Feedback:
    """No feedback: the optimizer goes on from its own positions, with its own weights.

    ``kappa``: κ of equation 36, which only ``paper`` has.
    """

    positions = False  # the next step starts from the corrected positions
    links = False  # the links' confidence c_ij weights the next step's ranges

    def __init__(self, kappa: float = KAPPA) -> None:
        self.kappa = kappa

    def confidence(
        self,
        before: Float64[Tensor, "B N N"],
        inputs: StepInput,
        corrected: Solution,
        correction: Correction,
        std: float,
    ) -> Float64[Tensor, "B N N"]:
        """The links' confidence after a step; without a range, as before."""
        return before


class PositionFeedback(Feedback):
    """The next step starts from the corrected positions and their variance."""

    positions = True


class LinkFeedback(Feedback):
    """The network's confidence of each link weights the next step's ranges."""

    links = True

    def confidence(
        self,
        before: Float64[Tensor, "B N N"],
        inputs: StepInput,
        corrected: Solution,
        correction: Correction,
        std: float,
    ) -> Float64[Tensor, "B N N"]:
        """Nearer to the network's by at most 10 %, at least ``_C_MIN``."""
        change = (correction.confidence.double().clamp_min(_C_MIN) / before).log()
        after = before * torch.exp(_MAX_RATE * torch.tanh(change / _MAX_RATE))
        return torch.where(inputs.links.mask, after, before)


class LearnedFeedback(LinkFeedback):
    """Both positions and links."""

    positions = True


class PaperFeedback(Feedback):
    """Equation 36: c_ij ← c_ij exp(−κ |d̃_ij − ‖p̂_i − p̂_j‖|/σ), at most 10 % less in a step and
    at least ``_C_MIN``.

    It accumulates: a confidence never rises again, as the paper has nothing that would raise it.
    """

    links = True

    def confidence(
        self,
        before: Float64[Tensor, "B N N"],
        inputs: StepInput,
        corrected: Solution,
        correction: Correction,
        std: float,
    ) -> Float64[Tensor, "B N N"]:
        residual = inputs.links.distance - lengths(corrected.position)
        factor = torch.exp(-self.kappa * residual.abs() / std).clamp_min(1 - _MOST)
        return torch.where(inputs.links.mask, (before * factor).clamp_min(_C_MIN), before)


FEEDBACKS: dict[FeedbackKind, type[Feedback]] = {
    "none": Feedback,
    "paper": PaperFeedback,
    "links": LinkFeedback,
    "positions": PositionFeedback,
    "learned": LearnedFeedback,
}
