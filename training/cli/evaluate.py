"""``coloc evaluate``."""

import os
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from training.cli.options import (
    Data,
    Device,
    Jobs,
    Ray,
    ScenarioName,
    Seed,
    Settings,
    Threads,
    build_scenario,
    require_device,
    require_seed,
    workers_of,
)
from training.cli.terminal import progress, show

if TYPE_CHECKING:
    from training.evaluation.results import Evaluation

_TOO_WIDE = ("rmse_std", "mean", "avg_particles")  # columns left out on a terminal


def evaluate(
    scenario: ScenarioName,
    agents: Annotated[
        str,
        typer.Option(
            metavar="A,B,C",
            help="Agents, with commas between; options follow a name after colons: "
            "**ekf,ekf:robust=huber**.",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results.")],
    runs: Annotated[int, typer.Option(help="Worlds, seeded SEED, SEED + 1, …")] = 20,
    seed: Seed = 0,
    settings: Settings = None,
    figures: Annotated[bool, typer.Option("--figures/--no-figures", help="Draw figures.")] = True,
    vector: Annotated[
        bool, typer.Option("--vector", help="Draw them as SVG, in place of PNG.")
    ] = False,
    report: Annotated[
        bool, typer.Option("--report", help="Write report.html, too: see **coloc report**.")
    ] = False,
    bound: Annotated[
        bool, typer.Option("--bound/--no-bound", help="Compute the posterior bound.")
    ] = True,
    threads: Threads = 1,
    device: Device = "cpu",
    jobs: Jobs = 1,
    ray: Ray = None,
    data: Data = None,
) -> None:
    """Let agents meet the same worlds, and write how well each localizes.

    The table is printed first. DIR receives results.json, results.csv, table.md, figures, the first
    run's trajectories as TUM files, and runs.safetensors, which reports are made of; results that
    are there already are replaced once everything is done. If an agent ends in an error, or figures
    cannot be drawn, the rest is written all the same, and the exit code is 1.

    **Examples**

    coloc evaluate indoor-v0 --agents ekf,pf500 --runs 20 --out results/indoor

    coloc evaluate indoor-v0 --agents ekf,ekf:robust=huber --set nlos=0.3 --set landmarks=5
    --out results/hard

    coloc evaluate indoor-v0 --agents ekf,pf500,apf --runs 1000 --ray auto --out results/many

    coloc evaluate replay-mrclam-v0 --agents dead_reckoning,ekf --data ~/recordings --out results/uw
    """
    require_seed(seed)
    from coloc_env.staging import staged_folder

    built = build_scenario(scenario, settings, threads, data)
    from training.evaluation import files
    from training.evaluation.evaluate import evaluate as run
    from training.evaluation.evaluate import split_agents

    if report:
        from training.evaluation.report.page import plotly_script

        plotly_script()  # what is not installed is said before anything runs
    names = split_agents(agents)
    require_device(device, jobs, ray)
    drawn = True
    with staged_folder(out, files.NAMES) as folder:
        with workers_of(jobs, ray) as workers, progress() as bars:
            found = run(built, names, runs, seed, bars, bound=bound, workers=workers, device=device)
        with suppress(OSError, SystemExit):  # where nobody reads it, the files are still written
            _show(found)
        files.write(found, folder)
        if report:
            drawn = _drawn("report", partial(files.write_report, found, out.name, folder))
        if figures:
            drawn = _drawn("figures", partial(files.write_figures, found, folder, vector)) and drawn
    typer.echo(f"written to {out}")
    if found.errors or not drawn:
        raise typer.Exit(1)


def _show(found: "Evaluation") -> None:
    """Print the table, and what went wrong."""
    from training.evaluation.tables import (
        COLUMNS,
        INNOVATION_COLUMNS,
        heading,
        innovation_rows,
        left_out,
        rows,
    )

    columns = {key: title for key, title in COLUMNS.items() if key not in _TOO_WIDE}
    consistent = f"NEES: {found.scenario.arena.dim} is consistent, more is overconfident"
    typer.echo(f"{heading(found)}; position errors in m; {consistent}")
    show(["", *columns.values()], rows(found, columns))
    if found.innovations:
        show(list(INNOVATION_COLUMNS), innovation_rows(found))
    if found.dropped:
        typer.echo(f"note: {left_out(found)}", err=True)
    for name, one in found.agents.items():
        if one.messages:
            count = f"{len(one.messages)} of {found.runs} runs"
            what = f"{name} raised in {count}; first at {one.messages[0]}"
            typer.echo(f"warning: {what}", err=True)
    for name, error in found.errors.items():
        typer.echo(f"error: {name} has no results: {error}", err=True)


def _drawn(what: str, draw: Callable[[], None]) -> bool:
    """Whether something could be drawn; if not, say why."""
    os.environ["MPLBACKEND"] = "Agg"  # a notebook's backend, say, is not here
    try:
        with progress() as bars:
            bars(what, 0, 1)
            draw()
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        typer.echo(f"error: no {what} could be drawn: {text}", err=True)
        return False
    return True
