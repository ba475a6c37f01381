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
_MAX_RATE = math.log(1.1)  # of a confidence in a step, as a logarithm: the paper's 10 %
_C_MIN = 0.1  # smallest confidence of a link
_KAPPA = 0.05  # κ of equation 36


class Feedback:
    """No feedback: the optimizer goes on from its own positions, with its own weights."""

    positions = False  # the next step starts from the corrected positions
    links = False  # the links' confidence c_ij weights the next step's ranges

    def target(
        self, inputs: StepInput, corrected: Solution, correction: Correction, std: float
    ) -> Float64[Tensor, "B N N"]:
        """The confidence that links should have after a step."""
        return correction.confidence.double()

    def confidence(
        self,
        before: Float64[Tensor, "B N N"],
        inputs: StepInput,
        corrected: Solution,
        correction: Correction,
        std: float,
    ) -> Float64[Tensor, "B N N"]:
        """The links' confidence after a step: nearer to the target by at most 10 %, at least
        ``_C_MIN``; without a range, as before."""
        if not self.links:
            return before
        target = self.target(inputs, corrected, correction, std)
        change = (target.clamp_min(_C_MIN) / before).log()
        after = before * torch.exp(_MAX_RATE * torch.tanh(change / _MAX_RATE))
        return torch.where(inputs.links.mask, after, before)


class PositionFeedback(Feedback):
    """The next step starts from the corrected positions and their variance."""

    positions = True


class LinkFeedback(Feedback):
    """The network's confidence of each link weights the next step's ranges."""

    links = True


class LearnedFeedback(Feedback):
    """Both positions and links."""

    positions = True
    links = True


class PaperFeedback(LinkFeedback):
    """Links by equation 36: c_ij → exp(−κ |d̃_ij − ‖p̂_i − p̂_j‖|/σ)."""

    def target(
        self, inputs: StepInput, corrected: Solution, correction: Correction, std: float
    ) -> Float64[Tensor, "B N N"]:
        residual = inputs.links.distance - lengths(corrected.position)
        return torch.exp(-_KAPPA * (residual.abs() / std))


FEEDBACKS: dict[FeedbackKind, type[Feedback]] = {
    "none": Feedback,
    "paper": PaperFeedback,
    "links": LinkFeedback,
    "positions": PositionFeedback,
    "learned": LearnedFeedback,
}
