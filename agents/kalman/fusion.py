"""How a filter takes in what is measured between UAVs: what fusion methods have in common.

A method works after a UAV's own measurements, one other UAV at a time, on ``Rows``: all numbers
that are measured between the two, each with its derivatives by both ends' errors.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from agents.kalman.filter import Beside
from agents.models.measurements import Block, Measurement, Neighbours
from agents.models.process import Process
from agents.robust import Prediction, Trust
from coloc_env.observation import Observation
from coloc_env.scenario import Believed


@dataclass(frozen=True)
class Rows:
    """r numbers that each UAV measures of the UAV in one of its slots: residuals, derivatives H by
    its own error and J by the other's position, variances R; H = J = 0 where nothing was."""

    residual: Float[Tensor, "B N r"]
    own: Float[Tensor, "B N r E"]
    partner: Float[Tensor, "B N r d"]
    variance: Float[Tensor, "B N r"]


@dataclass(frozen=True)
class Taken:
    """What one update did: state and covariance after it, A = I − K H, what it keeps of the error,
    and the gains of all measurements of each model."""

    state: Float[Tensor, "B N S"]
    covariance: Float[Tensor, "B N E E"]
    kept: Float[Tensor, "B N E E"]
    gains: dict[Measurement, Float[Tensor, "B N E m k"]]


class Fusion(ABC):
    """A method for the cooperative ``models`` of a team; ``shared`` as in ``GaussianBelief``."""

    def __init__(self, believed: Believed, process: Process, models: Sequence[Measurement]) -> None:
        self.believed, self.process, self.models = believed, process, models

    @abstractmethod
    def initial(self, observation: Observation) -> Float[Tensor, "B N H"]:
        """What is kept of other UAVs before the first step."""

    @abstractmethod
    def neighbours(self, prior: Prediction) -> Neighbours:
        """Where the UAVs in each slot are, as far as one knows before anything is measured."""

    @abstractmethod
    def fuse(
        self, prior: Prediction, beside: Beside, trusts: Sequence[Trust]
    ) -> tuple[list[Taken], Float[Tensor, "B N H"]]:
        """The updates of a belief by the models' measurements, so trusted, in turn, and what is
        kept of other UAVs then."""

    @abstractmethod
    def sent(self, shared: Float[Tensor, "B N H"]) -> Float[Tensor, "B N"]:
        """Bytes that each UAV sent in the step that ended so."""

    def scaled(
        self, shared: Float[Tensor, "B N H"], kept: Float[Tensor, "B N E E"]
    ) -> Float[Tensor, "B N H"]:
        """What is kept of other UAVs after a transition, or an update, that keeps F, or A, of a
        UAV's error."""
        return shared

    def remember(
        self, shared: Float[Tensor, "B N H"], covariance: Float[Tensor, "B N E E"]
    ) -> Float[Tensor, "B N H"]:
        """The same at the end of a step, with the covariance that a UAV then reports."""
        return shared

    def linearize(
        self,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
    ) -> list[Block]:
        """The models' blocks at a state."""
        return [m.linearize(self.process, x, observation, neighbours) for m in self.models]


def rows_of(
    blocks: Sequence[Block],
    trusts: Sequence[Trust],
    slots: int,
    which: Int64[Tensor, "B N"],
    halved: bool = False,
) -> Rows:
    """All that the blocks hold of the UAV in slot ``which``, so trusted; ``halved``: what both ends
    measured as one counts half (the other end counts the rest)."""
    parts = []
    for block, trust in zip(blocks, trusts, strict=True):
        assert block.partner is not None
        information = trust.information(block)
        if halved and block.mutual:
            information = 0.5 * information
        there = information > 0
        own = torch.where(there.unsqueeze(-1), block.jacobian, 0.0)
        partner = torch.where(there.unsqueeze(-1), block.partner, 0.0)
        residual = torch.where(there, trust.residual(block), 0.0)
        variance = torch.where(there, 1 / information, 1.0)
        columns = torch.cat(
            (own, partner, residual.unsqueeze(-1), variance.unsqueeze(-1)), -1
        ).unflatten(2, (-1, slots, block.per_slot))  # [B, N, lead, slot, per_slot, k, c]
        index = which[..., None, None, None, None, None].expand(
            *columns.shape[:3], 1, *columns.shape[4:]
        )
        parts.append(columns.gather(3, index).flatten(2, 5))
    whole, e = torch.cat(parts, 2), blocks[0].jacobian.shape[-1]
    return Rows(whole[..., -2], whole[..., :e], whole[..., e:-2], whole[..., -1])


def gains_of(
    models: Sequence[Measurement],
    blocks: Sequence[Block],
    gain: Float[Tensor, "B N E r"],
    slots: int,
    which: Int64[Tensor, "B N"],
) -> dict[Measurement, Float[Tensor, "B N E m k"]]:
    """The gains of rows as those of each model's measurements: 0 for all other slots."""
    found, start = {}, 0
    chosen = torch.nn.functional.one_hot(which, slots).to(gain.dtype)[:, :, None, None, :, None]
    for model, block in zip(models, blocks, strict=True):
        m, k = block.residual.shape[-2:]
        lead = m // (slots * block.per_slot)
        size = lead * block.per_slot * k
        part = gain[..., start : start + size].unflatten(-1, (lead, 1, block.per_slot * k))
        found[model] = (part * chosen).flatten(3).unflatten(-1, (m, k))
        start += size
    return found
