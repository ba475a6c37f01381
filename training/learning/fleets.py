"""Several Collectors as one: an epoch that is flown in several scenarios."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from itertools import zip_longest

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector


class Fleet(ABC):
    """Collectors of one epoch."""

    def __init__(self, collectors: Sequence[Collector]) -> None:
        self.collectors = collectors

    @abstractmethod
    def __iter__(self) -> Iterator[TensorDictBase]:
        """The epoch's batches."""

    def shutdown(self) -> None:
        """Let go of the environments."""
        for one in self.collectors:
            one.shutdown()


class TakingTurns(Fleet):
    """The collectors' batches one by one, a round at a time."""

    def __iter__(self) -> Iterator[TensorDictBase]:
        for batches in zip_longest(*self.collectors):
            yield from (batch for batch in batches if batch is not None)


class SideBySide(Fleet):
    """The collectors' batches of the same steps in one, row by row."""

    def __iter__(self) -> Iterator[TensorDictBase]:
        for batches in zip(*self.collectors, strict=True):
            yield torch.cat([batch.to_tensordict() for batch in batches])
