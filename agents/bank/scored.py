"""A screen that also remembers how well its filter predicted."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from agents.bank.evidence import predictive_score
from agents.models.measurements import Block, Measurement
from agents.robust import Prediction, Screen, Trust
from coloc_env.observation import Observation


@dataclass(frozen=True)
class Judgement:
    """A screen's evidence, and the predictive score of what is judged."""

    evidence: Any
    score: Float[Tensor, "B N"]


class Scored(Screen):
    """Another screen, whose memory gets one more column: the predictive score of the last step's
    measurements, by Student's t with ``degrees`` of freedom."""

    def __init__(self, screen: Screen, degrees: float) -> None:
        super().__init__(screen.process, screen.models)
        self.screen, self.degrees = screen, degrees
        self.exchanges, self.extra = screen.exchanges, screen.extra

    def memory(self, observation: Observation) -> Float[Tensor, "B N K"]:
        memory = self.screen.memory(observation)
        return torch.cat((memory, memory.new_zeros(*memory.shape[:-1], 1)), -1)

    def judge(self, blocks: Sequence[Block], prediction: Prediction) -> Judgement:
        return Judgement(
            self.screen.judge(blocks, without_score(prediction)),
            measured_score(self.models, blocks, prediction.covariance, self.degrees),
        )

    def weigh(self, blocks: Sequence[Block], evidence: Judgement, last: bool) -> list[Trust]:
        return self.screen.weigh(blocks, evidence.evidence, last)

    def remember(
        self, prediction: Prediction, evidence: Judgement, after: Callable[[], Sequence[Block]]
    ) -> Float[Tensor, "B N K"]:
        own = self.screen.remember(without_score(prediction), evidence.evidence, after)
        return torch.cat((own, evidence.score.to(own).unsqueeze(-1)), -1)


def measured_score(
    models: Sequence[Measurement],
    blocks: Sequence[Block],
    covariance: Float[Tensor, "B N E E"],
    degrees: float,
) -> Float64[Tensor, "B N"]:
    """The predictive score of what is measured: beliefs that enter like measurements do not
    count."""
    pairs = zip(models, blocks, strict=True)
    measured = [block for model, block in pairs if model.testable]
    return predictive_score(measured, covariance, degrees)


def without_score(prediction: Prediction) -> Prediction:
    """The prediction with what the screen itself remembers."""
    memory = prediction.memory[..., :-1]
    return Prediction(prediction.state, prediction.covariance, prediction.observation, memory)
