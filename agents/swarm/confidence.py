"""Kinds of confidence in links: weights of ranges, and estimation of their errors.

Equation 19 of ST-DCL weights each squared residual by W_ij = w(τ) c_ij. A kind of confidence gives
the weights, shifts of the ranges, the information that a range then has, and what is remembered of
each link from step to step.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.swarm import calibration, persistence, weights
from agents.swarm.belief import Solution, StepInput, SwarmBelief
from agents.swarm.calibration import ErrorModel
from agents.swarm.links import lengths

ConfidenceKind = Literal["none", "huber", "em", "paper"]
SolvedKind = Literal[ConfidenceKind, "gnc"]  # for solutions of several iterations
_ENOUGH = 50.0  # remembered errors of links between anchors: with fewer, all links are used
Weights = tuple[Float64[Tensor, "B *L"], Float64[Tensor, "B *L"]]


class Confidence(ABC):
    """Weights of ranges with noise of ``std`` σ (m)."""

    def __init__(self, std: float) -> None:
        self.std = std

    @abstractmethod
    def weights(self, residual: Float64[Tensor, "B *L"], inputs: StepInput) -> Weights:
        """Each link's weight W_ij (1/m²) and shift (m) at its residual (m)."""

    def schedule(
        self, inputs: StepInput, iterations: int
    ) -> tuple[Callable[[Float64[Tensor, "B N N"]], Weights], int]:
        """``weights`` for the successive iterations of one solution, and how many it takes where
        ``iterations`` are asked for."""
        return lambda residual: self.weights(residual, inputs), iterations

    def initial_memory(self, model: ErrorModel, shape: torch.Size) -> Float64[Tensor, "B N L"]:
        """What is remembered of links before the first step."""
        return model.sums.new_zeros(*shape, 0)

    def calibrate(
        self, inputs: StepInput, memory: Float64[Tensor, "B N L"], dense: bool
    ) -> StepInput:
        """The inputs with what the step's links show of their errors."""
        return inputs

    def information(
        self, weight: Float64[Tensor, "B *L"], inputs: StepInput
    ) -> Float64[Tensor, "B *L"]:
        """Fisher information (1/m²) of each range."""
        return weight

    def remember(
        self, memory: Float64[Tensor, "B N L"], inputs: StepInput, solution: Solution
    ) -> Float64[Tensor, "B N L"]:
        """What is remembered of links after a step."""
        return memory

    def diagnostics(self, belief: SwarmBelief) -> dict[str, Float64[Tensor, "B N"]]:
        """What is believed of range errors."""
        return {}


class UniformConfidence(Confidence):
    """All links alike: 1/σ²."""

    def weights(self, residual: Float64[Tensor, "B *L"], inputs: StepInput) -> Weights:
        return weights.uniform(residual, inputs.links.mask, self.std)


class HuberConfidence(Confidence):
    """Huber's loss on each residual."""

    def weights(self, residual: Float64[Tensor, "B *L"], inputs: StepInput) -> Weights:
        return weights.huber(residual, inputs.links.mask, inputs.pair_variance, self.std)


class PaperConfidence(HuberConfidence):
    """Huber's loss times the paper's c_ij (equation 17). It remembers each link's rate of packet
    loss."""

    def initial_memory(self, model: ErrorModel, shape: torch.Size) -> Float64[Tensor, "B N N"]:
        return model.sums.new_zeros(*shape, shape[1])

    def calibrate(
        self, inputs: StepInput, memory: Float64[Tensor, "B N N"], dense: bool
    ) -> StepInput:
        lost = (~inputs.links.mask).double()
        return replace(inputs, packet_loss=memory + (lost - memory) / calibration.MEMORY_STEPS)

    def weights(self, residual: Float64[Tensor, "B *L"], inputs: StepInput) -> Weights:
        assert inputs.packet_loss is not None
        weight, shift = super().weights(residual, inputs)
        c = weights.paper_confidence(residual, inputs.packet_loss, inputs.pair_variance, self.std)
        return weight * c, shift

    def remember(
        self, memory: Float64[Tensor, "B N N"], inputs: StepInput, solution: Solution
    ) -> Float64[Tensor, "B N N"]:
        assert inputs.packet_loss is not None
        return inputs.packet_loss


class GncConfidence(Confidence):
    """Truncated least squares by graduated non-convexity (Yang, Antonante, Tzoumas & Carlone, RA-L
    2020): ranges beyond three deviations are outliers."""

    def weights(self, residual: Float64[Tensor, "B *L"], inputs: StepInput) -> Weights:
        """Those of the truncated loss itself."""
        weight, shift = weights.uniform(residual, inputs.links.mask, self.std)
        return weight * ((residual / self.std).square() < weights.TRUNCATED), shift

    def schedule(
        self, inputs: StepInput, iterations: int
    ) -> tuple[Callable[[Float64[Tensor, "B N N"]], Weights], int]:
        """The surrogate's weights, from nearly convex (μ small) to nearly the truncated loss."""
        mu: Float64[Tensor, "B 1 1"] | None = None

        def graduated(residual: Float64[Tensor, "B N N"]) -> Weights:
            nonlocal mu
            squared = (residual / self.std).square().masked_fill(~inputs.links.mask, 0.0)
            mu = weights.first_mu(squared) if mu is None else weights.GRADUATION * mu
            weight, shift = weights.uniform(residual, inputs.links.mask, self.std)
            return weight * weights.truncated(squared, mu), shift

        return graduated, max(iterations, weights.GRADUATIONS)


class EmConfidence(Confidence):
    """A mixture of line-of-sight and NLOS errors, fitted by EM to links between anchors
    (``agents.swarm.calibration``). It remembers each link's probability of NLOS, which persists
    (``agents.swarm.persistence``)."""

    def initial_memory(self, model: ErrorModel, shape: torch.Size) -> Float64[Tensor, "B N N"]:
        return model.sums.new_zeros(*shape, shape[1]) + model.share[:, 1, None, None]

    def calibrate(
        self, inputs: StepInput, memory: Float64[Tensor, "B N N"], dense: bool
    ) -> StepInput:
        """The inputs with the error model and the transitions after this step's links between
        anchors, and each link's NLOS probability, predicted from its ``memory``. Where such links
        are few, but links are ``dense``, all others count as well, with the variance of the vectors
        between their ends."""
        links = inputs.links
        members = inputs.fixed.any(0).nonzero()[:, 0]
        known = links.mask & inputs.fixed.unsqueeze(-1) & inputs.fixed.unsqueeze(-2)
        remembered = 0.5 * calibration.MEMORY_STEPS * known.sum((-2, -1)).to(torch.float32)
        others = dense * (1 - remembered / _ENOUGH).clamp_min(0.0)[:, None, None]
        if bool((others > 0).any()):
            members = torch.arange(links.mask.shape[-1], device=members.device)
        rows, columns = members.unsqueeze(-1), members

        def pairs(x: Float64[Tensor, "B N N"]) -> Float64[Tensor, "B L"]:
            return torch.triu(x[:, rows, columns], 1).flatten(1)

        counts = pairs(torch.where(known, 1.0, others) * links.mask)
        error = pairs(links.distance - lengths(inputs.prior))
        variance = pairs(inputs.pair_variance)
        model = calibration.em_update(inputs.error_model, error, counts, variance, self.std)
        share = model.share[:, 1]
        transitions = persistence.update(
            inputs.transitions,
            pairs(memory),
            calibration.log_likelihood_ratio(model, error, variance, self.std),
            counts,
            share,
        )
        rho = persistence.persistence(transitions)
        prior = persistence.predict(memory.flatten(1), rho, share).view_as(memory)
        return replace(
            inputs, error_model=model, transitions=transitions, outlier_probability=prior
        )

    def weights(self, residual: Float64[Tensor, "B *L"], inputs: StepInput) -> Weights:
        weight, shift = calibration.weights_and_shifts(
            inputs.error_model,
            residual,
            inputs.pair_variance,
            self.std,
            inputs.outlier_probability,
        )
        return weight * inputs.links.mask, shift

    def information(
        self, weight: Float64[Tensor, "B *L"], inputs: StepInput
    ) -> Float64[Tensor, "B *L"]:
        """Less than the weight: it is not known which of the components the error is of."""
        assert inputs.outlier_probability is not None
        each = calibration.fisher_information(
            inputs.error_model, inputs.outlier_probability.flatten(1), self.std
        )
        each = each.view_as(weight) * inputs.links.mask
        return each if inputs.confidence is None else inputs.confidence * each

    def remember(
        self, memory: Float64[Tensor, "B N N"], inputs: StepInput, solution: Solution
    ) -> Float64[Tensor, "B N N"]:
        """Each link's posterior probability of NLOS; the predicted one without a range."""
        prior = inputs.outlier_probability
        assert prior is not None
        if solution.outlier is not None:
            return torch.where(inputs.links.mask, solution.outlier, prior)
        pairs = inputs.links.pairs
        posterior = calibration.outlier_posterior(
            inputs.error_model,
            pairs.of(solution.residual(inputs).detach()),
            pairs.of(solution.range_variance(inputs)),
            self.std,
            pairs.of(prior),
        )
        return pairs.put(prior, posterior)

    def diagnostics(self, belief: SwarmBelief) -> dict[str, Float64[Tensor, "B N"]]:
        sums, shape = belief.error_sums[:, 0], belief.step.shape
        model = ErrorModel(sums=sums, batch_size=sums.shape[:1])
        mean, _ = model.component(self.std)
        rho = persistence.persistence(belief.transitions[:, 0])
        return {
            "outlier_share": model.share[:, 1:].expand(shape),
            "outlier_bias": mean[:, 1:].expand(shape),
            "outlier_persistence": rho.unsqueeze(-1).expand(shape),
        }


CONFIDENCES: dict[SolvedKind, type[Confidence]] = {
    "none": UniformConfidence,
    "huber": HuberConfidence,
    "em": EmConfidence,
    "paper": PaperConfidence,
    "gnc": GncConfidence,
}
