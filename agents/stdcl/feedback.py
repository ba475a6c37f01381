"""Kinds of feedback from the graph network to the optimizer (ST-DCL paper, section 4.2.3)."""

import math
from typing import Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.stdcl.network import Correction
from agents.swarm.belief import Solution, StepInput

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
    judged = False  # it is the network's

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
        """The links' confidence after a step, of pairs without a range as before."""
        return before


class PositionFeedback(Feedback):
    """The next step starts from the corrected positions and their variance."""

    positions = True


class LinkFeedback(Feedback):
    """The network's confidence of each link weights the next step's ranges."""

    links = judged = True

    def confidence(
        self,
        before: Float64[Tensor, "B N N"],
        inputs: StepInput,
        corrected: Solution,
        correction: Correction,
        std: float,
    ) -> Float64[Tensor, "B N N"]:
        """Nearer to the network's by at most 10 %, at least ``_C_MIN``."""
        assert correction.confidence is not None
        pairs = inputs.links.pairs
        c = pairs.of(before)
        change = (correction.confidence.double().clamp_min(_C_MIN) / c).log()
        c = c * torch.exp(_MAX_RATE * torch.tanh(change / _MAX_RATE))
        return pairs.put(before, c)


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
        pairs = inputs.links.pairs
        residual = inputs.listed.links.distance - pairs.units(corrected.position)[1]
        factor = torch.exp(-self.kappa * residual.abs() / std).clamp_min(1 - _MOST)
        c = (pairs.of(before) * factor).clamp_min(_C_MIN)
        return pairs.put(before, c)


FEEDBACKS: dict[FeedbackKind, type[Feedback]] = {
    "none": Feedback,
    "paper": PaperFeedback,
    "links": LinkFeedback,
    "positions": PositionFeedback,
    "learned": LearnedFeedback,
}
