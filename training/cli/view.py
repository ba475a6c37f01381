"""``coloc view``."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from training.cli.options import Data, Seed, Settings, Threads, build_scenario, require_seed
from training.cli.terminal import progress

_OF_A_SCENARIO = {
    "agent": "--agent",
    "steps": "--steps",
    "seed": "--seed",
    "settings": "--set",
    "threads": "--threads",
    "data": "--data",
}


def view(
    context: typer.Context,
    what: Annotated[
        str,
        typer.Argument(metavar="SCENARIO|RUN", help="A scenario, or the folder of an evaluation."),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The recording, FILE.rrd.")] = Path(
        "view.rrd"
    ),
    agent: Annotated[str, typer.Option(help="Who localizes, in a scenario.")] = "ekf",
    steps: Annotated[int, typer.Option(help="Steps of a scenario to run.")] = 300,
    seed: Seed = 0,
    settings: Settings = None,
    show: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the viewer, where there is a screen.")
    ] = True,
    threads: Threads = 1,
    data: Data = None,
) -> None:
    """Write a recording for rerun's viewer, and open it.

    Truth, estimates with ellipsoids and particles, links, ranges by how well they fit, landmarks,
    walls, radio traffic, errors and NEES over time. Needs the extra **view** (rerun-sdk).

    **Examples**

    coloc view indoor-v0 --agent pf500 --set motion=random

    coloc view results/indoor --out indoor.rrd --no-open
    """
    require_seed(seed)
    if out.suffix.lower() != ".rrd":
        raise ValueError(f"--out {out} is not allowed: a name ending in .rrd")
    from coloc_env.staging import staged_file

    if Path(what).is_dir():
        _require_no_scenario(context, what)
        from training.evaluation.runs import read
        from training.evaluation.viewing import view_runs

        runs = read(Path(what))
        with staged_file(out) as file:
            view_runs(runs, file)
    elif Path(what).is_file():
        raise ValueError(f"{what} is a file: a scenario's name or the folder of an evaluation")
    else:
        built = build_scenario(what, settings, threads, data)
        if not 1 <= steps <= built.horizon:
            raise ValueError(f"--steps {steps} is not allowed: 1 to {built.horizon} for {what}")
        from agents.registry import make
        from training.evaluation.viewing import view_scenario

        with staged_file(out) as file, progress() as bars:
            localizer = make(agent, built)
            view_scenario(
                localizer, built, seed, steps, file, lambda done: bars(agent, done, steps)
            )
    typer.echo(f"written to {out}")
    screen = sys.platform in ("darwin", "win32") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    if show and screen:
        subprocess.Popen([sys.executable, "-m", "rerun", str(out)], start_new_session=True)
    elif show:
        typer.echo(f"no screen here: open it with `rerun {out}`")


def _require_no_scenario(context: typer.Context, folder: str) -> None:
    """Raise ValueError for options of a scenario beside the folder of an evaluation."""
    for name, option in _OF_A_SCENARIO.items():
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            raise ValueError(f"{option} is for a scenario: {folder} is a folder, shown as it is")
