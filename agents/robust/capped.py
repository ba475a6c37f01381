"""Any screen's trust, capped by Huber's weights."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.measurements import Block
from agents.robust.huber import huber_weights
from agents.robust.screen import Prediction, Screen, Trust
from coloc_env.observation import Observation


def capped(weights: Sequence[Float[Tensor, "B N m"]], trusts: Sequence[Trust]) -> list[Trust]:
    """min(w, weight) of each block's weights; shifts stay."""
    return [
        Trust(w if t.weight is None else torch.minimum(w, t.weight), t.shift)
        for w, t in zip(weights, trusts, strict=True)
    ]


class Capped(Screen):
    """min(w_Huber, w) of another screen's weights w: it may doubt what Huber's weights believe, and
    believes nothing that they doubt. While an update iterates, Huber's weights stand in for both.
    """

    def __init__(self, screen: Screen) -> None:
        super().__init__(screen.process, screen.models)
        self.screen = screen
        self.exchanges, self.extra = screen.exchanges, screen.extra

    def memory(self, observation: Observation) -> Float[Tensor, "B N K"]:
        return self.screen.memory(observation)

    def judge(self, blocks: Sequence[Block], prediction: Prediction) -> Any:
        return self.screen.judge(blocks, prediction)

    def weigh(self, blocks: Sequence[Block], evidence: Any, last: bool) -> list[Trust]:
        huber = [huber_weights(block) for block in blocks]
        if not last:
            return [Trust(weight) for weight in huber]
        return capped(huber, self.screen.weigh(blocks, evidence, last))

    def remember(
        self, prediction: Prediction, evidence: Any, after: Callable[[], Sequence[Block]]
    ) -> Float[Tensor, "B N K"]:
        return self.screen.remember(prediction, evidence, after)
