"""Epochs of fresh worlds, as TorchRL's Trainer takes them: one Collector after the other."""

from collections.abc import Callable, Iterator
from typing import Any, Protocol

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector

from coloc_env.envs.torchrl import CoLocEnv, PerUavEnv

_TRAINING_WORLDS = 1 << 40  # far from the seeds that anyone evaluates with
_PER_SEED = 1 << 24  # worlds that one training may fly


class Flight(Protocol):
    """An epoch's batches: a Collector's, or those of several."""

    def __iter__(self) -> Iterator[TensorDictBase]: ...

    def shutdown(self) -> None: ...


class Flights:
    """The Trainer's collector: in every epoch worlds are flown from their start.

    ``launch(epoch)`` makes that epoch's flight from the epoch's index alone, so that an epoch is
    the same whether or not those before it were flown by this process: what makes resuming exact.
    ``epoch`` is the one in the air; ``landed(epochs_flown)`` is called when its last batch has been
    trained on and logged.
    """

    init_random_frames = 0  # which the Trainer asks for

    def __init__(self, launch: Callable[[int], Flight], epochs: int) -> None:
        self.launch = launch
        self.epochs = epochs
        self.epoch = 0
        self.landed: Callable[[int], None] = lambda epochs: None

    def __iter__(self) -> Iterator[TensorDictBase]:
        while self.epoch < self.epochs:
            flight = self.launch(self.epoch)
            yield from flight
            flight.shutdown()
            self.epoch += 1
            self.landed(self.epoch)

    def state_dict(self) -> dict[str, Any]:
        """What a save point keeps: how many epochs have been flown."""
        return {"epoch": self.epoch}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.epoch = state["epoch"]

    def shutdown(self) -> None:
        """Nothing is left running between epochs."""


def fly(
    env: CoLocEnv | PerUavEnv, policy: TensorDictModuleBase, steps: int, **options: Any
) -> Collector:
    """A Collector for one flight of an environment's worlds, from their start to the horizon (to
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


def world_seed(seed: int, epoch: int, worlds: int) -> int:
    """Seed of the first of an epoch's ``worlds``, which no other epoch, and no other training with
    another ``seed``, flies."""
    return _TRAINING_WORLDS + seed * _PER_SEED + epoch * worlds
