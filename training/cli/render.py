"""``coloc render``."""

import os
from pathlib import Path
from typing import Annotated

import typer

from training.cli.options import (
    Data,
    Device,
    ScenarioName,
    Seed,
    Settings,
    Threads,
    build_scenario,
    require_seed,
)
from training.cli.terminal import progress

_FRAMES = 300  # at most, in an animation


def render(
    scenario: ScenarioName,
    out: Annotated[Path, typer.Option(metavar="FILE", help="An animation .gif or a picture .png.")],
    agent: Annotated[str, typer.Option(help="Who localizes.")] = "ekf",
    steps: Annotated[int, typer.Option(help="Steps to show; a picture shows the last.")] = 100,
    seed: Seed = 0,
    settings: Settings = None,
    threads: Threads = 1,
    device: Device = "cpu",
    data: Data = None,
) -> None:
    """Draw a world and what an agent makes of it.

    **Examples**

    coloc render indoor-v0 --agent ekf --steps 200 --out flight.gif

    coloc render indoor-v0 --agent pf500 --set motion=random --seed 3 --out world.png
    """
    require_seed(seed)
    suffix = out.suffix.lower()
    if suffix not in (".gif", ".png"):
        raise ValueError(f"--out {out} is not allowed: a name ending in .gif or .png")
    from coloc_env.staging import staged_file

    built = build_scenario(scenario, settings, threads, data)
    if not 1 <= steps <= built.horizon:
        raise ValueError(f"--steps {steps} is not allowed: 1 to {built.horizon} for {scenario}")
    os.environ["MPLBACKEND"] = "Agg"  # a notebook's backend, say, is not here
    from agents.registry import make
    from coloc_env.render import frame_to_png, save_animation
    from training.devices import checked_device
    from training.evaluation.animation import frames

    on = checked_device(device)

    every = steps if suffix == ".png" else -(-steps // _FRAMES)
    with staged_file(out) as file, progress() as bars:
        localizer = make(agent, built).to(on)
        drawn = frames(localizer, built, seed, steps, every, lambda k: bars(agent, k, steps), on)
        if suffix == ".png":
            frame_to_png(list(drawn)[-1], file)
        else:
            save_animation(list(drawn), file, min(30.0, max(10.0, 1 / (every * built.arena.dt))))
    typer.echo(f"written to {out}")
