"""Learned trust as a screen: Huber's weights while an update iterates, the networks' at its end."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.measurements import (
    AnchorRanges,
    Block,
    LandmarkRangeBearings,
    LandmarkVectors,
    Measurement,
    UavRangeBearings,
    UavRanges,
)
from agents.models.process import Process
from agents.robust.huber import huber_weights
from agents.robust.screen import Prediction, Screen, Trust
from agents.trust.features import (
    MEMORY,
    Innovation,
    features,
    innovation,
    log_std,
    remembered,
    running_count,
)
from agents.trust.network import SHARED, TrustNetwork
from agents.weights import learned
from coloc_env.observation import Observation

_RANGES = (AnchorRanges, UavRanges)
_VECTORS = (LandmarkVectors, LandmarkRangeBearings, UavRangeBearings)


@dataclass(frozen=True)
class Evidence:
    """The judged blocks at the prior: innovations, the links' memory, log of the
    position's standard deviation, log(1 + number) of vector measurements and ranges seen, and the
    running mean of the former."""

    first: list[Innovation]
    memory: list[Float[Tensor, "B N m 3"]]
    own_std: Float[Tensor, "B N"]
    counts: list[Float[Tensor, "B N"]]
    running_count: Float[Tensor, "B N 1"]


class TrustScreen(Screen):
    """The networks judge landmarks, bearings and ranges; other sensors are trusted.

    The memory holds running means: of how many vectors are seen, and of every link's innovations,
    block by block. Huber's weights stand in until the last iteration, whose residuals the networks
    see.
    """

    extra = 3

    def __init__(
        self, process: Process, models: Sequence[Measurement], network: TrustNetwork
    ) -> None:
        super().__init__(process, models)
        self.network = network
        self.judged = [i for i, m in enumerate(models) if isinstance(m, _RANGES + _VECTORS)]
        self.ranges = {i for i, m in enumerate(models) if isinstance(m, _RANGES)}

    def memory(self, observation: Observation) -> Float[Tensor, "B N K"]:
        links = sum(self.models[i].count(observation) for i in self.judged)
        size = 1 + MEMORY * links
        return torch.zeros(
            *observation.batch_size, size, dtype=torch.float32, device=observation.device
        )

    def judge(self, blocks: Sequence[Block], prediction: Prediction) -> Evidence:
        judged = [blocks[i] for i in self.judged]
        before, *parts = prediction.memory.to(prediction.state.dtype).split(
            [1, *(MEMORY * block.mask.shape[-1] for block in judged)], -1
        )
        relative = self.network.relative
        first = [innovation(block, prediction.covariance, relative) for block in judged]
        totals = torch.zeros(2, *prediction.state.shape[:2], dtype=prediction.state.dtype)
        totals = totals.to(prediction.state.device)
        for i, one in zip(self.judged, first, strict=True):
            totals[int(i in self.ranges)] += one.seen.sum(-1)
        counts = list(totals.log1p())
        now = running_count(before, counts[0])
        return Evidence(
            first=first,
            memory=[part.unflatten(-1, (-1, MEMORY)) for part in parts],
            own_std=log_std(prediction, self.process.dim),
            counts=[*counts, now[..., 0]],
            running_count=now,
        )

    def weigh(self, blocks: Sequence[Block], evidence: Evidence, last: bool) -> list[Trust]:
        if not last:
            return [Trust(huber_weights(block)) for block in blocks]
        trusts = [Trust()] * len(blocks)
        for i, first, memory in zip(self.judged, evidence.first, evidence.memory, strict=True):
            block = blocks[i]
            seen = features(
                block, first, evidence.own_std, evidence.counts, memory, self.network.relative
            )
            # Behind a mask may be anything; the networks must not see it.
            seen = seen.detach().to(torch.float32).masked_fill(~block.mask.unsqueeze(-1), 0.0)
            if i in self.ranges:
                weight, bias = self.network.trust_ranges(seen)
                shift = bias * block.variance[..., 0].sqrt()
                trusts[i] = Trust(weight.to(block.residual.dtype), shift)
            else:
                weight = self.network.trust_vectors(seen[..., : len(SHARED)])
                trusts[i] = Trust(weight.to(block.residual.dtype))
        return trusts

    def remember(
        self, prediction: Prediction, evidence: Evidence, after: object
    ) -> Float[Tensor, "B N K"]:
        parts = [
            remembered(memory, first).flatten(-2)
            for memory, first in zip(evidence.memory, evidence.first, strict=True)
        ]
        return torch.cat((evidence.running_count, *parts), -1).to(prediction.memory.dtype)


def learned_screen(
    process: Process,
    models: Sequence[Measurement],
    weights: str,
    bank: bool,
    options: dict[str, Any],
) -> TrustScreen:
    """The screen that judges by a checkpoint's networks, and by nothing beside them; ``auto``:
    those trained for a ``bank``, or for use alone."""
    if options.get("robust", "none") != "none":
        raise ValueError("robust is not allowed beside learned trust: none")
    if weights == "auto":
        weights = "trust_bank" if bank else "trust"
    network = learned(TrustNetwork, weights).requires_grad_(False)
    return TrustScreen(process, models, network)
