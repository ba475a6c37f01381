"""Training runs: one directory each, that a dead process's successor continues exactly.

- run.json: what is trained, with which options, command and versions;
- metrics/, tensorboard/: training.learning.logger;
- state.safetensors: the save point of the last whole epoch, until the run is finished;
- NAME.safetensors, NAME.json: the trained weights and their card, once it is.
"""

import json
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch.optim import Optimizer
from torchrl.objectives import LossModule
from torchrl.trainers import DefaultOptimizationStepper, Trainer

from agents.weights import SUFFIX, Learned
from coloc_env import options
from coloc_env.staging import staged_folder
from training.evaluation.results import typed
from training.learning import checkpoints
from training.learning import state as savepoints
from training.learning.collectors import Flights
from training.learning.logger import RunLogger
from training.learning.registry import TRAININGS

Progress = Callable[[str, int, int], None]
_CONFIG, _STATE = "run.json", "state.safetensors"
_MOST = 10**9  # of anything that can be chosen; seeds included
_EVER = 1 << 62  # frames: the flights end a training, not a number of frames
_VERSIONS = ("coloc-env", "torch", "torchrl", "tensordict", "safetensors", "numpy")


class Epochs(Protocol):
    """How far a training is, in whole epochs; ``landed`` is called after each."""

    epoch: int
    epochs: int
    landed: Callable[[int], None]


class Trains(Protocol):
    """What runs ask of a trainer: TorchRL's Trainer, or one that does the same."""

    logger: Any
    collected_frames: int

    def train(self) -> None: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> None: ...


@dataclass(frozen=True)
class Training:
    """What there is to a training beside its directory.

    ``module`` is what learns, and is written at the end; ``trainer`` is ``make_trainer``'s over
    ``flights``, with hooks of its own (or both are another library's); ``score`` measures what was
    learned, for the card.
    """

    module: Learned
    flights: Epochs
    trainer: Trains
    score: Callable[[Progress], Mapping[str, Any]]


class _Stepper(DefaultOptimizationStepper):
    """TorchRL's, whose losses would keep their graphs for the logger."""

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        return super().step(trainer, sub_batch).detach()


def at_least(training: str, least: int, **chosen: int) -> None:
    """ValueError for a whole number chosen below ``least``, or beyond all sense."""
    for name, value in chosen.items():
        if not least <= value < _MOST:
            raise ValueError(f"{training}: {name}={value} is not allowed: {least} to {_MOST}")


def positive(training: str, **chosen: float) -> None:
    """ValueError for a number that is not more than 0."""
    for key, value in chosen.items():
        if not 0 < value < float("inf"):
            raise ValueError(f"{training}: {key}={value} is not allowed: more than 0")


def shares(training: str, **chosen: float) -> None:
    """ValueError for a number beyond [0, 1]."""
    for key, value in chosen.items():
        if not 0 <= value <= 1:
            raise ValueError(f"{training}: {key}={value} is not allowed: a number in [0, 1]")


def make_trainer(
    flights: Flights,
    loss: LossModule,
    optimizer: Optimizer,
    steps_per_batch: int | None = 1,
    *,
    passes: int = 1,
    clip_norm: float | None = None,
) -> Trainer:
    """TorchRL's Trainer as runs need it: every batch is logged, and nothing is saved but by runs.

    A batch is trained on in ``passes`` times ``steps_per_batch`` optimizer steps (None: as many as
    a replay buffer's iteration gives); ``clip_norm`` bounds the gradient's norm.
    """
    return Trainer(
        collector=flights,
        total_frames=_EVER,
        frame_skip=1,
        optim_steps_per_batch=steps_per_batch,
        num_epochs=passes,
        loss_module=loss,
        optimizer=optimizer,
        optimization_stepper=_Stepper(),
        clip_norm=clip_norm,
        progress_bar=False,
        log_interval=0,
    )


def start(name: str, chosen: Mapping[str, Any], out: Path, tell: Progress) -> Path:
    """Train from the beginning, in the directory ``out``; returns the weights' file."""
    chosen = options.checked(name, chosen, TRAININGS.options_of(name))
    if (out / _CONFIG).exists():
        raise ValueError(f"{out} holds a run: --resume {out} continues it")
    if out.is_dir() and any(out.iterdir()):
        raise ValueError(f"{out} is not empty: a run has a folder of its own")
    TRAININGS[name](**chosen)  # what is wrong with the options is said before anything is written
    config = {
        "training": name,
        "options": dict(chosen),
        "command": _command(name, chosen, out),
        "threads": torch.get_num_threads(),
        "versions": _versions(),
    }
    with staged_folder(out, [_CONFIG]) as folder:
        (folder / _CONFIG).write_text(json.dumps(config, indent=2) + "\n")
    return _go_on(out, config, tell)


def resume(folder: Path, tell: Progress) -> Path:
    """Continue the run in a directory to the weights that it would have had if it had never
    stopped; returns their file."""
    config = _config(folder)
    for leftover in folder.rglob(".*.partial-*"):
        leftover.unlink()
    torch.set_num_threads(config["threads"])
    return _go_on(folder, config, tell)


def _go_on(folder: Path, config: Mapping[str, Any], tell: Progress) -> Path:
    name = config["training"]
    weights = folder / f"{name}{SUFFIX}"
    if weights.with_suffix(".json").exists():
        return weights
    training = TRAININGS[name](**config["options"])
    trainer, flights, state = training.trainer, training.flights, folder / _STATE
    if state.exists():
        trainer.load_state_dict(savepoints.load(state))
    logger = trainer.logger = RunLogger(folder, trainer.collected_frames)
    tell(name, flights.epoch, flights.epochs)

    def save(epochs: int) -> None:
        savepoints.save(state, trainer.state_dict())
        tell(name, epochs, flights.epochs)

    flights.landed = save
    trainer.train()
    logger.close()
    card = {
        "command": config["command"],
        "training": name,
        "options": {key: p.default for key, p in TRAININGS.options_of(name).items()}
        | config["options"],
        "epochs": flights.epochs,
        "frames": trainer.collected_frames,
        "versions": _versions(),
        "metrics": logger.last,
        "scores": training.score(tell),
    }
    checkpoints.write(weights, training.module, card)
    state.unlink(missing_ok=True)
    return weights


def _config(folder: Path) -> dict[str, Any]:
    """What a run's directory says of it; ValueError if it says nothing that makes sense."""
    file = folder / _CONFIG
    if not file.is_file():
        raise ValueError(f"{folder} holds no run: {file} does not exist")
    try:
        config = json.loads(file.read_text())
    except ValueError as error:
        raise ValueError(f"{file} is not JSON: {error}") from None
    needed = {"training": str, "options": dict, "command": str, "threads": int}
    for key, kind in needed.items():
        if not isinstance(config, dict) or not isinstance(config.get(key), kind):
            raise ValueError(f"{file} describes no run: {', '.join(needed)} are needed")
    name = config["training"]
    config["options"] = options.checked(name, config["options"], TRAININGS.options_of(name))
    return config


def _command(name: str, chosen: Mapping[str, Any], out: Path) -> str:
    """The command line that starts the same run."""
    settings = "".join(f" --set {key}={typed(value)}" for key, value in chosen.items())
    return f"coloc train {name}{settings} --out {out}"


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in _VERSIONS:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found
