"""Training runs: one folder each, which another process can continue exactly.

- run.json: what is trained, with which options, command and versions; locked while a process trains
- metrics/, tensorboard/: training.learning.logger; curves.json, curves.png once it is finished
- state.safetensors: the state after the last whole epoch, until the run is finished
- NAME.safetensors, NAME.json: the trained weights and their card, once it is
"""

import inspect
import json
import platform
import shlex
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Protocol

import torch
from tensordict import TensorDictBase
from torch.optim import Optimizer
from torchrl.objectives import LossModule
from torchrl.trainers import DefaultOptimizationStepper, Trainer

from agents.weights import SUFFIX, Learned, card_of, shipped, write
from coloc_env import options, state_file
from coloc_env.json_files import read_json
from coloc_env.options import Quantity, set_words
from coloc_env.staging import locked, recover, remove_leftovers, staged_folder
from training.devices import checked_device
from training.learning import curves
from training.learning.collectors import EpochCollector
from training.learning.logger import RunLogger
from training.learning.registry import TRAININGS
from training.pool import ALONE, Workers
from training.threads import use_threads

Progress = Callable[[str, int, int], None]
_CONFIG, _STATE = "run.json", "state.safetensors"
_FIELDS = {
    "training": str,
    "options": dict,
    "command": str,
    "threads": Annotated[int, Quantity("", 1, 1 << 12)],
}
_OPTIONAL = {"versions": dict[str, str], "device": str}
_UNBOUNDED = 1 << 62  # frames: the epochs end a training, not a number of frames
_VERSIONS = ("coloc-env", "torch", "torchrl", "tensordict", "safetensors", "numpy")


class CountsEpochs(Protocol):
    """How far a training is, in whole epochs; ``on_epoch_end`` is called after each."""

    epoch: int
    epochs: int
    on_epoch_end: Callable[[int], None]


class TrainerLike(Protocol):
    """What runs ask of a trainer: TorchRL's Trainer, or one that does the same."""

    logger: Any
    collected_frames: int

    def train(self) -> None: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> None: ...


@dataclass(frozen=True)
class Training:
    """What there is to a training beside its folder.

    ``module`` is what learns, and is written at the end; ``trainer`` is ``make_trainer``'s over
    ``collector``, with hooks of its own (or both are another library's); ``score(progress)``
    measures what was learned, for the card.
    """

    module: Learned
    collector: CountsEpochs
    trainer: TrainerLike
    score: Callable[[Progress], Mapping[str, Any]]


class _Stepper(DefaultOptimizationStepper):
    """TorchRL's, whose losses would keep their graphs for the logger."""

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        return super().step(trainer, sub_batch).detach()


def make_trainer(
    collector: EpochCollector,
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
        collector=collector,
        total_frames=_UNBOUNDED,
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


def start(
    name: str,
    chosen: Mapping[str, Any],
    out: Path,
    progress: Progress,
    workers: Workers = ALONE,
    device: str = "cpu",
) -> Path:
    """Train from the beginning, in the folder ``out``; returns the weights' file. Rollouts are
    spread over ``workers``; worlds, networks and losses are on ``device``. Raises ValueError for
    options that do not fit, a training that workers cannot share or that knows no other device than
    the CPU, or a folder in use, before anything is written."""
    chosen = options.checked(name, chosen, TRAININGS.options_of(name))
    _require_new(out)
    training = _spread(name, _built(name, chosen, device), workers)
    config = {
        "training": name,
        "options": dict(chosen),
        "command": _command(name, chosen, out, device),
        **({} if device == "cpu" else {"device": device}),
        "threads": torch.get_num_threads(),
        "versions": _versions(),
    }
    _require_new(out)  # still
    with staged_folder(out, [_CONFIG]) as folder:
        text = json.dumps(config, indent=2, ensure_ascii=False) + "\n"
        (folder / _CONFIG).write_text(text, encoding="utf-8")
    with _alone(out):
        return _train(out, config, training, progress)


def recipe(source: str) -> tuple[str, dict[str, Any]]:
    """What a config file trains, and with which options: a run's run.json, a checkpoint's card, or
    any JSON with ``training`` and ``options``; by path, or a shipped checkpoint's name.

    Raises ValueError if it holds neither.
    """
    fields = {"training": str, "options": dict}
    if source in shipped():
        return _recipe(f"checkpoint {source}", card_of(source))
    file = Path(source)
    if not file.is_file():
        known = ", ".join(shipped())
        raise ValueError(f"{file}: no such file, and no checkpoint of that name: {known}")
    return _recipe(str(file), read_json(file, "a training's config", fields))


def _recipe(source: str, config: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    if not {"training", "options"} <= config.keys():
        raise ValueError(f"{source} does not say how it was trained")
    return config["training"], config["options"]


def resume(folder: Path, progress: Progress, workers: Workers = ALONE) -> Path:
    """Continue the run in a folder to the weights that it would have had if it had never stopped;
    returns their file."""
    config = _config(folder)
    weights = _weights(folder, config)
    if weights.with_suffix(".json").exists():
        return weights
    with _alone(folder):
        remove_leftovers(folder)
        use_threads(config["threads"], f"{folder / _CONFIG}: threads")
        name = config["training"]
        device = config.get("device", "cpu")
        try:
            checked_device(device)
        except ValueError as error:
            raise ValueError(f"{folder / _CONFIG}: {error}") from None
        training = _spread(name, _built(name, config["options"], device), workers)
        return _train(folder, config, training, progress)


def _train(folder: Path, config: Mapping[str, Any], training: Training, progress: Progress) -> Path:
    """Train from the folder's state, if there is one, to the end."""
    name, weights, file = config["training"], _weights(folder, config), folder / _STATE
    trainer, collector = training.trainer, training.collector
    if file.exists():
        _restore(file, config, trainer)
    logger = trainer.logger = RunLogger(folder, trainer.collected_frames)
    progress(name, collector.epoch, collector.epochs)

    def save(epochs: int) -> None:
        logger.sync()
        state_file.save(file, {"run": _identity(config), "trainer": trainer.state_dict()})
        progress(name, epochs, collector.epochs)

    collector.on_epoch_end = save
    trainer.train()
    logger.close()
    training.module.to("cpu")  # where it is scored, whatever it was trained on
    _require_learned(name, training)
    defaults = {key: one.default for key, one in TRAININGS.options_of(name).items()}
    card = {
        "command": config["command"].rsplit(" --out ", 1)[0] + " --out DIR",  # of any machine
        "training": name,
        "options": defaults | config["options"],
        "epochs": collector.epochs,
        "frames": trainer.collected_frames,
        "versions": _versions(),
        "metrics": logger.last,
        "scores": training.score(progress),
    }
    curves.write(folder, name)
    write(weights, training.module, card)
    file.unlink(missing_ok=True)
    return weights


def _built(name: str, chosen: Mapping[str, Any], device: str) -> Training:
    factory, where = TRAININGS[name], () if device == "cpu" else (device,)
    if where and "device" not in inspect.signature(factory).parameters:
        raise ValueError(f"{name} trains on the CPU: --device {device} is not for it")
    try:
        training: Training = factory(*where, **options.grouped(factory, chosen))
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "memory" not in str(error):
            raise
        raise ValueError(f"{name}: these options need more memory than there is") from None
    if not hasattr(training, "trainer"):
        raise ValueError(f"{name}: a Training is needed, not {type(training).__name__}")
    return training


def _spread(name: str, training: Training, workers: Workers) -> Training:
    """The training, its rollouts on workers; ValueError if they cannot be spread."""
    if workers == ALONE:
        return training
    from training.learning.episodes import spread

    spread(name, training.collector, workers)
    return training


def _require_new(out: Path) -> None:
    """Raise ValueError if a folder holds a run, or anything else."""
    if (out / _CONFIG).exists():
        raise ValueError(f"{out} holds a run: --resume {out} continues it")
    if out.is_dir():
        recover(out)
        if any(not entry.name.startswith(f".{out.resolve().name}.") for entry in out.iterdir()):
            raise ValueError(f"{out} is not empty: a run has a folder of its own")


def _require_learned(name: str, training: Training) -> None:
    """Raise ValueError for a training that has seen nothing, or has lost its numbers."""
    if training.trainer.collected_frames == 0:
        raise ValueError(f"{name}: no frames were collected, so nothing was learned")
    for key, value in training.module.state_dict().items():
        if not bool(torch.isfinite(value).all()):
            raise ValueError(
                f"{name}: {key} is NaN or infinite after training; a lower learning rate may help"
            )


def _alone(folder: Path) -> AbstractContextManager[None]:
    """The run's lock; ValueError if another process trains in the folder."""
    return locked(folder / _CONFIG, f"{folder} is in use: another process trains there")


def _weights(folder: Path, config: Mapping[str, Any]) -> Path:
    return folder / f"{config['training']}{SUFFIX}"


def _identity(config: Mapping[str, Any]) -> str:
    """What a state is of: another training's, or one's with other options, does not fit."""
    return json.dumps([config["training"], config["options"]], sort_keys=True)


def _restore(file: Path, config: Mapping[str, Any], trainer: TrainerLike) -> None:
    """Put a state into a trainer; ValueError if it is another run's."""
    found = state_file.load(file)
    if found.get("run") != _identity(config):
        raise ValueError(
            f"{file} is the state of {found.get('run')}, {_CONFIG} describes {_identity(config)}"
        )
    try:
        trainer.load_state_dict(found["trainer"])
    except (LookupError, AttributeError, TypeError, ValueError, RuntimeError) as error:
        text = " ".join(str(error).split())
        raise ValueError(
            f"{file} does not fit this version's {config['training']}: {text}"
        ) from None


def _config(folder: Path) -> dict[str, Any]:
    """A folder's run.json; ValueError if there is none, or it does not describe a run."""
    file = folder / _CONFIG
    if folder.is_dir():
        recover(folder)
    if not file.is_file():
        raise ValueError(f"{folder} holds no run: {file} does not exist")
    config = read_json(file, "a run", _FIELDS, _OPTIONAL)
    name = config["training"]
    try:
        config["options"] = options.checked(name, config["options"], TRAININGS.options_of(name))
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    return config


def _command(name: str, chosen: Mapping[str, Any], out: Path, device: str) -> str:
    """The command line that starts the same run, as a shell reads it."""
    words = ["coloc", "train", name, *set_words(chosen)]
    words += [] if device == "cpu" else ["--device", device]
    return shlex.join([*words, "--out", str(out)])


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in _VERSIONS:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found
