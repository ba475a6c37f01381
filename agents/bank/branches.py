"""Two branches of one filter as rows of one batch."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.bank.evidence import predictive_score
from agents.models.measurements import Block
from agents.robust import Prediction, Screen, Trust
from coloc_env.observation import Observation


@dataclass(frozen=True)
class Judgements:
    """Both screens' evidence about their rows, and the predictive score of all rows."""

    fallback: Any
    candidate: Any
    score: Float[Tensor, "B N"]


class Branched(Screen):
    """Two screens on a batch of twice as many worlds: ``fallback`` judges the first half of the
    rows, ``candidate`` the second.

    The memory holds what either remembers, and in its last column the predictive score of the last
    step's measurements.
    """

    def __init__(self, fallback: Screen, candidate: Screen, degrees: float) -> None:
        super().__init__(candidate.process, candidate.models)
        self.fallback, self.candidate, self.degrees = fallback, candidate, degrees
        self.exchanges = fallback.exchanges or candidate.exchanges
        self.extra = max(fallback.extra, candidate.extra)

    def memory(self, observation: Observation) -> Float[Tensor, "B N K"]:
        own = (screen.memory(observation) for screen in (self.fallback, self.candidate))
        return torch.cat((*own, observation["prior"][..., :1] * 0.0), -1)

    def judge(self, blocks: Sequence[Block], prediction: Prediction) -> Judgements:
        first, second = self._apart(prediction)
        return Judgements(
            self.fallback.judge(_half(blocks, 0), first),
            self.candidate.judge(_half(blocks, 1), second),
            predictive_score(blocks, prediction.covariance, self.degrees),
        )

    def weigh(self, blocks: Sequence[Block], evidence: Judgements, last: bool) -> list[Trust]:
        first = self.fallback.weigh(_half(blocks, 0), evidence.fallback, last)
        second = self.candidate.weigh(_half(blocks, 1), evidence.candidate, last)
        return [
            Trust(_joined(a.weight, b.weight, 1.0), _joined(a.shift, b.shift, 0.0))
            for a, b in zip(first, second, strict=True)
        ]

    def remember(
        self,
        prediction: Prediction,
        evidence: Judgements,
        after: Callable[[], Sequence[Block]],
    ) -> Float[Tensor, "B N K"]:
        first, second = self._apart(prediction)
        one = self.fallback.remember(first, evidence.fallback, lambda: _half(after(), 0))
        other = self.candidate.remember(second, evidence.candidate, lambda: _half(after(), 1))
        rows = (
            torch.cat((one, torch.zeros_like(other)), -1),
            torch.cat((torch.zeros_like(one), other), -1),
        )
        return torch.cat((torch.cat(rows), evidence.score.unsqueeze(-1)), -1).to(prediction.memory)

    def _apart(self, prediction: Prediction) -> tuple[Prediction, Prediction]:
        """Both halves, each with its own screen's memory."""
        size = self.fallback.memory(prediction.observation).shape[-1]
        columns = slice(0, size), slice(size, -1)
        b = len(prediction.state) // 2
        rows = slice(0, b), slice(b, None)
        first, second = (
            Prediction(
                prediction.state[row],
                prediction.covariance[row],
                Observation({k: leaf[row] for k, leaf in prediction.observation.leaves.items()}),
                prediction.memory[row][..., column],
            )
            for row, column in zip(rows, columns, strict=True)
        )
        return first, second


def twice(observation: Observation) -> Observation:
    """What both branches observe: the same."""
    return Observation({k: torch.cat((leaf, leaf)) for k, leaf in observation.leaves.items()})


def copied(rows: Bool[Tensor, "B N"], source: Any, into: Any) -> Any:
    """A filter's belief with those of the UAVs in ``rows`` replaced by ``source``'s, but for what
    its screen remembers."""
    if not bool(rows.any()):
        return into
    parts = {
        name: torch.where(
            rows.reshape(*rows.shape, *[1] * (value.ndim - 2)), getattr(source, name), value
        )
        for name, value in into.items()
        if name != "memory"
    }
    return into.replace(**parts)


def _half(blocks: Sequence[Block], half: int) -> list[Block]:
    """The blocks of the first (0) or second (1) half of the rows."""
    return [_rows(block, half) for block in blocks]


def _rows(block: Block, half: int) -> Block:
    parts: dict[str, Any] = {
        field.name: value.chunk(2)[half]
        for field in fields(block)
        if isinstance(value := getattr(block, field.name), Tensor)
    }
    return replace(block, **parts)


def _joined(one: Tensor | None, other: Tensor | None, blank: float) -> Tensor | None:
    """Two halves' weights or shifts, ``blank`` where a half has none."""
    like = one if other is None else other
    if like is None:
        return None
    parts = (torch.full_like(like, blank) if part is None else part for part in (one, other))
    return torch.cat(tuple(parts))
