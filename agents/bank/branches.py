"""Two branches of one filter as rows of one batch."""

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.bank.scored import Judgement, measured_score
from agents.models.measurements import Block
from agents.robust import Prediction, Screen, Trust
from agents.robust.capped import capped
from agents.robust.huber import huber_weights
from agents.tensorclasses import build
from coloc_env.observation import Observation

T = TypeVar("T")


class Branched(Screen):
    """Screen of a batch of twice as many worlds: Huber's weights in the first half of the rows (the
    fallback), another screen's, capped by Huber's, in the second (the candidate).

    While an update iterates, Huber's weights stand in for both. The memory holds the candidate's
    (zeros in the fallback), and in its last column the predictive score of the last step's
    measurements.
    """

    extra = 3  # as Huber's weights alone have

    def __init__(self, candidate: Screen, degrees: float) -> None:
        super().__init__(candidate.process, candidate.models)
        self.candidate, self.degrees = candidate, degrees
        self.exchanges = candidate.exchanges
        self.extra = max(self.extra, candidate.extra)

    def memory(self, observation: Observation) -> Float[Tensor, "B N K"]:
        return torch.cat(
            (self.candidate.memory(observation), observation["prior"][..., :1] * 0.0), -1
        )

    def judge(self, blocks: Sequence[Block], prediction: Prediction) -> Judgement:
        """The candidate's evidence about its rows, and the score of all."""
        return Judgement(
            self.candidate.judge(_second(blocks), _of_candidate(prediction)),
            measured_score(self.models, blocks, prediction.covariance, self.degrees),
        )

    def weigh(self, blocks: Sequence[Block], evidence: Judgement, last: bool) -> list[Trust]:
        huber = [huber_weights(block) for block in blocks]
        if not last:
            return [Trust(weight) for weight in huber]
        halves = [weight.chunk(2) for weight in huber]
        trusts = self.candidate.weigh(_second(blocks), evidence.evidence, last)
        trusts = capped([half[1] for half in halves], trusts)
        return [
            Trust(torch.cat((half[0], t.weight)), _after_zeros(t.shift))
            for half, t in zip(halves, trusts, strict=True)
            if t.weight is not None
        ]

    def remember(
        self,
        prediction: Prediction,
        evidence: Judgement,
        after: Callable[[], Sequence[Block]],
    ) -> Float[Tensor, "B N K"]:
        own = self.candidate.remember(
            _of_candidate(prediction), evidence.evidence, lambda: _second(after())
        )
        rows = torch.cat((torch.zeros_like(own), own))
        return torch.cat((rows, evidence.score.unsqueeze(-1)), -1).to(prediction.memory)


def twice(observation: Observation) -> Observation:
    """What both branches observe: the same."""
    return Observation({k: torch.cat((leaf, leaf)) for k, leaf in observation.leaves.items()})


def stacked(first: T, second: T) -> T:
    """Two tensorclasses of batch (B, N) as the rows of one."""
    parts = {k: torch.cat((value, getattr(second, k))) for k, value in first.items()}  # type: ignore[attr-defined]
    shape = first.batch_size  # type: ignore[attr-defined]
    return build(type(first), torch.Size((2 * shape[0], *shape[1:])), **parts)


def halves(rows: T) -> tuple[T, T]:
    """The two that ``stacked`` made one."""
    shape = rows.batch_size  # type: ignore[attr-defined]
    b = shape[0] // 2
    first, second = (
        build(type(rows), torch.Size((b, *shape[1:])), **{k: v[part] for k, v in rows.items()})  # type: ignore[attr-defined]
        for part in (slice(0, b), slice(b, None))
    )
    return first, second


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


def _of_candidate(prediction: Prediction) -> Prediction:
    """The candidate's rows, with its own memory."""
    b = len(prediction.state) // 2
    seen = {k: leaf[b:] for k, leaf in prediction.observation.leaves.items()}
    memory = prediction.memory[b:, :, :-1]
    return Prediction(prediction.state[b:], prediction.covariance[b:], Observation(seen), memory)


def _second(blocks: Sequence[Block]) -> list[Block]:
    """The second half of each block's rows."""
    return [_second_half(block) for block in blocks]


def _second_half(block: Block) -> Block:
    parts: dict[str, Any] = {
        field.name: value[len(value) // 2 :]
        for field in fields(block)
        if isinstance(value := getattr(block, field.name), Tensor)
    }
    return replace(block, **parts)


def _after_zeros(shift: Tensor | None) -> Tensor | None:
    return None if shift is None else torch.cat((torch.zeros_like(shift), shift))
