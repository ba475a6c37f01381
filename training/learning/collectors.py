"""Epochs of fresh worlds, as TorchRL's Trainer takes them: a new Collector in each."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import zip_longest
from typing import Annotated, Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector

from coloc_env.envs.torchrl import CoLocEnv, PerUavEnv
from coloc_env.options import Quantity
from coloc_env.scenario import Scenario

Seed = Annotated[int, Quantity("", 0, 10**9)]
Worlds = Annotated[int, Quantity("", 1, 1 << 16)]  # of an epoch, in parallel
Epochs = Annotated[int, Quantity("", 1, 10**5)]
Steps = Annotated[int, Quantity("", 1, 10**5)]
ScoreRuns = Annotated[int, Quantity("", 0, 10**5)]
Width = Annotated[int, Quantity("", 1, 1 << 12)]  # of a layer

_TRAINING_WORLDS = 1 << 40  # far from the seeds that anyone evaluates with
_WORLDS_PER_SEED = 1 << 24


class Batches(Protocol):
    """An epoch's batches: a Collector's, or those of several."""

    def __iter__(self) -> Iterator[TensorDictBase]: ...

    def shutdown(self) -> None: ...


class EpochCollector:
    """The Trainer's collector: in every epoch new worlds, from their start.

    ``make(epoch)`` makes that epoch's collector from the epoch's index alone, so that an epoch is
    the same whether or not those before it were run by this process: what makes resuming exact.
    ``epoch`` is the one that runs; ``on_epoch_end(epochs)`` is called with the number of finished
    epochs when the last batch of one has been trained on and logged; ``prepare`` is given an
    epoch's batches before any of them is made.
    """

    init_random_frames = 0  # which the Trainer asks for

    def __init__(self, make: Callable[[int], Batches], epochs: int) -> None:
        self.make = make
        self.epochs = epochs
        self.epoch = 0
        self.on_epoch_end: Callable[[int], None] = lambda epochs: None
        self.prepare: Callable[[Batches], Batches] = lambda batches: batches

    def __iter__(self) -> Iterator[TensorDictBase]:
        while self.epoch < self.epochs:
            collector = self.prepare(self.make(self.epoch))
            yield from collector
            collector.shutdown()
            self.epoch += 1
            self.on_epoch_end(self.epoch)

    def state_dict(self) -> dict[str, Any]:
        """What a run's state keeps: how many epochs are finished."""
        return {"epoch": self.epoch}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.epoch = state["epoch"]

    def shutdown(self) -> None:
        """Nothing is left running between epochs."""


def episode_collector(
    env: CoLocEnv | PerUavEnv, policy: TensorDictModuleBase, steps: int, **options: Any
) -> Collector:
    """A Collector for one episode of an environment's worlds, from their start to the horizon (to
    the last whole batch before it), in batches of ``steps`` steps; ``options`` are its own."""
    rows = env.batch_size.numel()
    return Collector(
        env,
        policy,
        frames_per_batch=rows * steps,
        total_frames=rows * (env.scenario.horizon // steps) * steps,
        auto_register_policy_transforms=True,
        **options,
    )


def require_batches(training: str, scenarios: Iterable[Scenario], steps: int) -> None:
    """Raise ValueError if a scenario's episode is shorter than a batch of ``steps`` steps: nothing
    of it would be learned."""
    shortest = min(scenario.horizon for scenario in scenarios)
    if steps > shortest:
        raise ValueError(
            f"{training}: steps={steps} is not allowed: at most {shortest}, the shortest horizon "
            "that is trained on"
        )


def world_seed(seed: int, epoch: int, worlds: int) -> int:
    """Seed of the first of an epoch's ``worlds``, which no other epoch, and no other training with
    another ``seed``, meets. ValueError when a training has used up its worlds."""
    if (epoch + 1) * worlds > _WORLDS_PER_SEED:
        raise ValueError(f"a training has {_WORLDS_PER_SEED} worlds: fewer epochs or worlds")
    return _TRAINING_WORLDS + seed * _WORLDS_PER_SEED + epoch * worlds


# ------------------------------------------------------------------ several collectors as one


class Several(ABC):
    """The collectors of one epoch as one, for training in several scenarios."""

    def __init__(self, collectors: Sequence[Collector]) -> None:
        self.collectors = collectors

    @abstractmethod
    def __iter__(self) -> Iterator[TensorDictBase]:
        """The epoch's batches."""

    def shutdown(self) -> None:
        """Let go of the environments."""
        for one in self.collectors:
            one.shutdown()


class RoundRobin(Several):
    """One batch of each collector after the other, round after round; a collector that has finished
    is left out."""

    def __iter__(self) -> Iterator[TensorDictBase]:
        for batches in zip_longest(*self.collectors):
            yield from (batch for batch in batches if batch is not None)


class Concatenated(Several):
    """The collectors' batches of the same steps in one, row by row."""

    def __iter__(self) -> Iterator[TensorDictBase]:
        for batches in zip(*self.collectors, strict=True):
            yield torch.cat([batch.to_tensordict() for batch in batches])
