"""Screens: how far each measurement of a step is to be trusted, decided while an update iterates.

Every filter works through one of these; a screen sees blocks, never a sensor's leaf or the truth.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.models.measurements import Block, Measurement
from agents.models.process import Process
from coloc_env.observation import Observation

_BROAD = 0.5  # m per axis: a prior wider than that knows too little to judge measurements by


@dataclass(frozen=True)
class Trust:
    """For a block of m measurements: weights ≥ 0 of their information (1 where None), and
    ``shift``, a bias that is taken off the residuals (in the measurement's unit)."""

    weight: Float[Tensor, "B N m"] | None = None
    shift: Float[Tensor, "B N m"] | None = None

    def residual(self, block: Block) -> Float[Tensor, "B N m k"]:
        """The block's residuals without the bias."""
        return block.residual if self.shift is None else block.residual - self.shift.unsqueeze(-1)

    def information(self, block: Block) -> Float[Tensor, "B N m k"]:
        """What each number counts: weight over variance, 0 where nothing was measured."""
        counted = block.mask if self.weight is None else self.weight * block.mask
        return counted.unsqueeze(-1) / block.total_variance


@dataclass(frozen=True)
class Prediction:
    """What a step's measurements are judged against: mean, error covariance, what was observed,
    and what the screen remembers of the steps before."""

    state: Float[Tensor, "B N S"]
    covariance: Float[Tensor, "B N E E"]
    observation: Observation
    memory: Float[Tensor, "B N K"]

    def broad(self, dim: int, std: float = _BROAD) -> Bool[Tensor, "B N"]:
        """Whether the position is hardly known: by more than ``std`` (m) an axis."""
        variance = self.covariance[..., :dim, :dim].diagonal(dim1=-2, dim2=-1).sum(-1)
        return variance > dim * std**2


class Screen(ABC):
    """Judges the blocks of some measurement models.

    ``judges``: it may trust a measurement less than another. ``exchanges``: it uses what linked
    neighbours measured, so that one localizer must act for the whole team. ``extra``: more
    iterations that it wants where the prior is broad.
    """

    judges = True
    exchanges = False
    extra = 0

    def __init__(self, process: Process, models: Sequence[Measurement]) -> None:
        self.process, self.models = process, models

    def memory(self, observation: Observation) -> Float[Tensor, "B N K"]:
        """What it remembers before the first step: nothing."""
        return torch.zeros(
            *observation.batch_size, 0, dtype=torch.float32, device=observation.device
        )

    @abstractmethod
    def judge(self, blocks: Sequence[Block], prediction: Prediction) -> Any:
        """Evidence from the innovations: the blocks linearized at the prediction."""

    @abstractmethod
    def weigh(self, blocks: Sequence[Block], evidence: Any, last: bool) -> list[Trust]:
        """Trust for the blocks of one iteration, ``last`` being that of the update's outcome."""

    def remember(
        self, prediction: Prediction, evidence: Any, after: Callable[[], Sequence[Block]]
    ) -> Float[Tensor, "B N K"]:
        """The memory that the next step gets; ``after()`` gives the blocks at the posterior."""
        return prediction.memory


class Fixed(Screen):
    """Trust that was decided elsewhere."""

    def __init__(
        self, process: Process, models: Sequence[Measurement], trusts: Sequence[Trust]
    ) -> None:
        super().__init__(process, models)
        self.trusts = list(trusts)

    def judge(self, blocks: Sequence[Block], prediction: Prediction) -> None:
        return None

    def weigh(self, blocks: Sequence[Block], evidence: None, last: bool) -> list[Trust]:
        return self.trusts
