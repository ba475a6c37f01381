"""``coloc reproduce``: a paper's experiments, its figures beside ours."""

import os
from pathlib import Path
from typing import Annotated

import typer

from training.cli.options import (
    Data,
    Device,
    Jobs,
    Ray,
    Seed,
    require_device,
    require_seed,
    workers_of,
)
from training.cli.terminal import progress
from training.threads import use_threads


def reproduce(
    study: Annotated[
        str,
        typer.Argument(
            metavar="STUDY", help="**pfnn**, **nnhpff**, **stdcl**, **cspf**, **marl**, or your own"
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the results and the store.")],
    part: Annotated[
        str,
        typer.Option(
            metavar="PART",
            help="**paper**: its own tables and figures; **robustness** (pfnn, nnhpff, cspf); "
            "**rivals**, **regimes**, **corrector** (pfnn); **detector**, **noise**, **bias** "
            "(nnhpff); **stress**, **learned**, **campus**, **theory**, **factors** (stdcl); "
            "**real**: recordings (stdcl, cspf); **all**.",
        ),
    ] = "all",
    runs: Annotated[
        int | None,
        typer.Option(
            help="Worlds of the main tables: 20 for **pfnn** (figure 9: 30), 100 for nnhpff and "
            "cspf, 50 for stdcl, 40 for marl; fewer where a run is expensive."
        ),
    ] = None,
    seed: Seed = 0,
    agents: Annotated[
        str | None,
        typer.Option(metavar="A,B,C", help="These agents only; the others are not run."),
    ] = None,
    variants: Annotated[
        str | None, typer.Option(metavar="A,B,C", help="These variants of worlds only.")
    ] = None,
    report_only: Annotated[
        bool, typer.Option("--report-only", help="Compute nothing: report what DIR/store has.")
    ] = False,
    page: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Compute nothing: write the page of DIR/results.json to FILE."
        ),
    ] = None,
    steps: Annotated[
        int | None, typer.Option(help="Cut runs to so many steps: for a first try.")
    ] = None,
    device: Device = "cpu",
    jobs: Jobs = 1,
    ray: Ray = None,
    fresh: Annotated[bool, typer.Option("--fresh", help="Throw the store away first.")] = False,
    data: Data = None,
) -> None:
    """Run a paper's experiments, and write its tables and figures with its numbers beside ours.

    What is done is kept in DIR/store at once: the same command, or one for another part, goes on
    where the last one stopped. Other settings, other code and other weights make other entries, so
    nothing is ever mixed. DIR receives page.md, which says what became of every claim,
    results.json with everything that the page shows, and figures.

    **marl** is no paper: it trains policies with five seeds each (DIR/runs, resumed where they
    stopped) and runs them beside the filters.

    **Examples**

    coloc reproduce pfnn --out results/pfnn --jobs 2

    coloc reproduce pfnn --out results/pfnn --ray auto

    coloc reproduce pfnn --out results/quick --part paper --runs 4 --steps 200

    coloc reproduce pfnn --out results/pfnn --part robustness --agents ekf,ekf_trust
    --variants default,nlos,hard

    coloc reproduce stdcl --out results/stdcl --part stress --variants nlos-0.15,nlos-0.5

    coloc reproduce cspf --out results/cspf --page docs/results/cspf.md
    """
    if page is not None:
        _write_page(out, page)
        return
    if data is not None:
        os.environ["COLOC_DATA"] = str(data)
    require_seed(seed)
    use_threads(1)
    from training.evaluation.evaluate import split_agents
    from training.reproduce.settings import Settings
    from training.reproduce.study import STUDIES
    from training.reproduce.study import reproduce as run

    require_device(device, jobs, ray)
    chosen = STUDIES.require(study)()
    with workers_of(jobs, ray) as workers, progress() as bars:
        settings = Settings(
            out,
            chosen.runs if runs is None else runs,
            part,
            seed,
            None if agents is None else split_agents(agents),
            None if variants is None else variants.split(","),
            steps,
            workers,
            fresh,
            report_only,
            device,
        )
        run(chosen, settings, bars, lambda line: typer.echo(line, err=True))
    typer.echo(f"written to {out}/page.md")


def _write_page(out: Path, file: Path) -> None:
    """The page alone, from the results that are there."""
    from coloc_env.staging import recover, staged_file
    from training.reproduce.page import read, render

    recover(out)
    content = read(out / "results.json")
    images = Path(os.path.relpath(out, file.parent)).as_posix()
    with staged_file(file) as written:
        written.write_text(render(content, f"{images}/"), encoding="utf-8")
    typer.echo(f"written to {file}")
