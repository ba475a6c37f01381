"""``coloc train``."""

import logging
from pathlib import Path
from typing import Annotated, Any

import typer

from training.cli.options import Device, Jobs, Ray, require_device, workers_of
from training.cli.terminal import explain, progress, show
from training.threads import use_threads


def train(
    name: Annotated[
        str | None, typer.Argument(metavar="[TRAINING]", help="What to train; none: list them.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Set one option of the training; repeat it for more. "
            "**coloc train TRAINING** lists them.",
        ),
    ] = None,
    config: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            help="Train as this says: a run.json, a checkpoint's card, or a shipped checkpoint's "
            "name. **--set** changes single options.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="New folder for the run; starts it.")
    ] = None,
    resume: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of a run to continue.")
    ] = None,
    threads: Annotated[
        int, typer.Option(help="CPU threads of torch; a run that continues keeps its own.")
    ] = 1,
    device: Device = "cpu",
    jobs: Jobs = 1,
    ray: Ray = None,
) -> None:
    """Train a learned part of an agent, or continue after an interruption.

    DIR receives run.json (options, command, versions), metrics/ (CSV) and tensorboard/, and at the
    end the weights, TRAINING.safetensors, with their card, TRAINING.json. A run that was
    interrupted, however abruptly, continues with --resume to exactly the weights that it would have
    had otherwise. Without --out and --resume the training's options are listed.

    **Examples**

    coloc train pfnn

    coloc train pfnn --out runs/corrector --set epochs=30 --set scenario=indoor-v0:motion=random

    coloc train pfnn --out runs/paper --set mode=online --set worlds=1

    coloc train --resume runs/corrector

    coloc train --config runs/corrector/run.json --set seed=1 --out runs/again

    coloc train task-mappo --out runs/survey --set task=survey-v0:reward=sigma

    coloc evaluate indoor-v0 --agents apf,pfnn:weights=runs/corrector/pfnn.safetensors --out results

    coloc train nnhpff --out runs/detector --ray auto

    coloc train trust --out runs/trust --device cuda

    tensorboard --logdir runs
    """
    use_threads(threads)
    from coloc_env.options import parse_all
    from training.learning import run
    from training.learning.registry import TRAININGS

    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it logs every buffer it makes
    require_device(device, jobs, ray)
    chosen: dict[str, Any] = {}
    if config is not None:
        if name is not None or out is None:
            raise ValueError("--config FILE says what to train, and --out DIR is needed")
        name, chosen = run.recipe(config)
    if resume is not None:
        if name is not None or out is not None or settings or device != "cpu":
            raise ValueError("--resume goes alone: a run continues as it was started")
        with workers_of(jobs, ray) as workers, progress() as bars:
            weights = run.resume(resume, bars, workers)
    elif name is None:
        show(["training", ""], [[key, TRAININGS.summary(key)] for key in TRAININGS])
        typer.echo("coloc train TRAINING lists its options.")
        return
    elif out is None:
        if settings:
            raise ValueError("--out DIR is needed: the run's folder")
        explain(name, TRAININGS, "option")
        return
    else:
        known = TRAININGS.options_of(name)
        chosen |= parse_all(name, settings or (), known)
        with workers_of(jobs, ray) as workers, progress() as bars:
            weights = run.start(name, chosen, out, bars, workers, device)
    typer.echo(f"weights written to {weights}")
