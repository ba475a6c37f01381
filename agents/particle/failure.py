"""Has a filter failed? Detectors by an estimate and the distances to anchors."""

from abc import ABC, abstractmethod
from copy import deepcopy
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float32
from torch import Tensor
from torch.nn import functional

from agents.models.measurements import AnchorRanges, no_neighbours
from agents.models.process import Process
from agents.robust.mahalanobis import chi_square
from agents.weights import Learned
from coloc_env.observation import Observation

ANCHORS = 4  # residuals that the network is fed
HIDDEN = (10, 5)


@dataclass(frozen=True)
class Evidence:
    """Residuals of an estimate to A anchors (of all tags): d = rᵀ R⁻¹ r of the residuals
    r = z − h(x̂), their sizes (m; 0 where nothing was measured), and how many there are."""

    distance: Float32[Tensor, "B N"]
    residuals: Float32[Tensor, "B N A"]
    count: Float32[Tensor, "B N"]

    @property
    def rms(self) -> Float32[Tensor, "B N"]:
        """√(Σ r² / n), m: what is left of d where nothing is believed of the noise."""
        return (self.residuals.square().sum(-1) / self.count.clamp_min(1.0)).sqrt()


def evidence(
    model: AnchorRanges,
    process: Process,
    state: Float[Tensor, "B N S"],
    observation: Observation,
) -> Evidence:
    """The evidence about a state (its position alone, unless tags have lever arms)."""
    alone = no_neighbours(state[..., : process.dim])
    if model.tags:
        block = model.linearize(process, state, observation, alone, derivatives=False)
        residual, mask = block.residual[..., 0] * block.mask, block.mask
        squared = residual.square() / block.variance[..., 0]
    else:
        ranges, anchors = model.ends(observation, alone)
        distance = (state[..., None, : process.dim] - anchors).norm(dim=-1)
        mask = model.read(observation)[1]
        residual = (ranges - distance) * mask
        squared = residual.square() / model.variance
    return Evidence(squared.sum(-1).float(), residual.abs().float(), mask.sum(-1).float())


class Detector(ABC):
    """Tells from evidence whether a filter has failed."""

    @abstractmethod
    def probability(self, seen: Evidence) -> Float32[Tensor, "B N"]:
        """The probability that it has; a test without probabilities gives 0 or 1."""


class ChiSquare(Detector):
    """Failed if d is beyond the quantile of χ² with as many degrees of freedom as ranges."""

    def __init__(self, quantile: float, most: int) -> None:
        limits = [chi_square(quantile, dof) for dof in range(1, most + 1)]
        self.limits = torch.tensor((torch.inf, *limits), dtype=torch.float32)

    def probability(self, seen: Evidence) -> Float32[Tensor, "B N"]:
        limits = self.limits.to(seen.count.device)[seen.count.long()]
        return (seen.distance > limits).float()


class ResidualSum(Detector):
    """Failed if the residuals' root mean square √(Σ r² / n) is beyond a ``limit`` (m)."""

    def __init__(self, limit: float) -> None:
        self.limit = limit

    def probability(self, seen: Evidence) -> Float32[Tensor, "B N"]:
        return (seen.rms > self.limit).float()


class FailureDetector(Learned):
    """5–10–5–2 network (tanh, softmax) on [d, |r₁| … |r₄|]: logits of (sound, failed).

    d enters as log(1 + d), whose scale does not depend on R as much.
    """

    kind = "nnhpff"
    features = ("log1p_d", "r1", "r2", "r3", "r4")

    def __init__(self) -> None:
        super().__init__()
        sizes = (1 + ANCHORS, *HIDDEN)
        self.hidden = torch.nn.ModuleList(map(torch.nn.Linear, sizes, sizes[1:]))
        self.out = torch.nn.Linear(HIDDEN[-1], 2)

    def forward(self, features: Float[Tensor, "*s 5"]) -> Float[Tensor, "*s 2"]:
        x = features
        for layer in self.hidden:
            x = torch.tanh(layer(x))
        logits: Tensor = self.out(x)
        return logits


def network_features(seen: Evidence) -> Float32[Tensor, "B N 5"]:
    """The network's input: with more than four ranges the four largest residuals and d of four out
    of so many; with fewer, zeros."""
    d, residuals = seen.distance, seen.residuals
    d = d * (ANCHORS / seen.count.clamp_min(1.0))
    if residuals.shape[-1] > ANCHORS:
        residuals = residuals.topk(ANCHORS, -1).values
    missing = ANCHORS - residuals.shape[-1]
    residuals = functional.pad(residuals, (0, missing)) if missing > 0 else residuals
    return torch.cat((d.log1p().unsqueeze(-1), residuals), -1)


class NeuralDetector(Detector):
    """Failure by the network's probability."""

    def __init__(self, network: FailureDetector) -> None:
        self.network = deepcopy(network).double().requires_grad_(False)

    def probability(self, seen: Evidence) -> Float32[Tensor, "B N"]:
        # In float64, so that the order of sums, which depends on the batch, shows nowhere.
        logits = self.network(network_features(seen).double())
        failed = torch.sigmoid(logits[..., 1] - logits[..., 0]).float()
        return failed * (seen.count > 0)
