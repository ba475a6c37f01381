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
_SHORTEST = 2  # hundredths of a second that viewers of GIFs show a frame, at least


def render(
    scenario: ScenarioName,
    out: Annotated[Path, typer.Option(metavar="FILE", help="An animation .gif or a picture .png.")],
    agent: Annotated[str, typer.Option(help="Who localizes.")] = "ekf",
    steps: Annotated[int, typer.Option(help="Steps to show; a picture shows the last.")] = 100,
    speed: Annotated[
        float | None,
        typer.Option(metavar="X", help="Of an animation: X times real time.  [default: readable]"),
    ] = None,
    width: Annotated[
        int | None,
        typer.Option(metavar="PIXELS", help="Width of the picture.  [default: 1200]"),
    ] = None,
    seed: Seed = 0,
    settings: Settings = None,
    threads: Threads = 1,
    device: Device = "cpu",
    data: Data = None,
) -> None:
    """Draw a world and what an agent makes of it.

    **Examples**

    coloc render indoor-v0 --agent ekf --steps 200 --out flight.gif

    coloc render swarm-v0 --agent map --speed 4 --width 800 --out swarm.gif

    coloc render indoor-v0 --agent pf500 --set motion=random --seed 3 --out world.png
    """
    require_seed(seed)
    suffix = out.suffix.lower()
    if suffix not in (".gif", ".png"):
        raise ValueError(f"--out {out} is not allowed: a name ending in .gif or .png")
    if speed is not None and (suffix == ".png" or not 0 < speed <= 1000):
        raise ValueError(f"--speed {speed:g} is not allowed: above 0, at most 1000, for a .gif")
    if width is not None and not 100 <= width <= 4000:
        raise ValueError(f"--width {width} is not allowed: 100 to 4000 pixels")
    from coloc_env.staging import staged_file

    built = build_scenario(scenario, settings, threads, data)
    if not 1 <= steps <= built.horizon:
        raise ValueError(f"--steps {steps} is not allowed: 1 to {built.horizon} for {scenario}")
    os.environ["MPLBACKEND"] = "Agg"  # a notebook's backend, say, is not here
    from agents.registry import make
    from coloc_env.render import frame_to_png, save_animation
    from coloc_env.render.shapes import WIDTH
    from training.devices import checked_device
    from training.evaluation.animation import frames

    on = checked_device(device)

    every, fps = _pace(steps, built.arena.dt, speed)
    every = steps if suffix == ".png" else every
    scale = (width or WIDTH) / WIDTH
    with staged_file(out) as file, progress() as bars:
        localizer = make(agent, built).to(on)
        drawn = frames(
            localizer, built, seed, steps, every, lambda k: bars(agent, k, steps), on, scale
        )
        if suffix == ".png":
            frame_to_png(list(drawn)[-1], file)
        else:
            save_animation(list(drawn), file, fps)
    typer.echo(f"written to {out}")


def _pace(steps: int, dt: float, speed: float | None) -> tuple[int, float]:
    """Every how many steps of ``dt`` s a frame is drawn, and how many frames are shown a second. A
    GIF counts in hundredths of a second: a frame takes so many that the speed is right to 2 %."""
    every = -(-steps // _FRAMES)
    if speed is None:
        return every, min(30.0, max(10.0, 1 / (every * dt)))
    for each in range(every, steps + 1):
        exact = 100 * each * dt / speed
        if exact >= _SHORTEST and abs(round(exact) - exact) <= 0.02 * exact:
            return each, 100 / round(exact)
    raise ValueError(f"--speed {speed:g} is not allowed: too fast for {steps} steps of {dt:g} s")
