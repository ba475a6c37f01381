"""``coloc reproduce``: a paper's experiments, its numbers beside ours."""

import os
import shutil
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from training.cli.terminal import progress


class Paper(StrEnum):
    """Papers that can be reproduced, and ``marl``: what policies learn in the environment."""

    pfnn = "pfnn"
    nnhpff = "nnhpff"
    stdcl = "stdcl"
    cspf = "cspf"
    marl = "marl"


_RUNS = {
    Paper.pfnn: 20,
    Paper.nnhpff: 100,
    Paper.stdcl: 50,
    Paper.cspf: 100,
    Paper.marl: 40,
}


class Part(StrEnum):
    """What of a paper's report."""

    paper = "paper"
    robustness = "robustness"
    stress = "stress"
    learned = "learned"
    campus = "campus"
    real = "real"
    all = "all"


_PARTS = {
    Paper.pfnn: (Part.paper, Part.robustness, Part.all),
    Paper.nnhpff: (Part.paper, Part.robustness, Part.all),
    Paper.stdcl: (Part.paper, Part.stress, Part.learned, Part.campus, Part.real, Part.all),
    Paper.cspf: (Part.paper, Part.robustness, Part.real, Part.all),
    Paper.marl: (Part.all,),
}


def reproduce(
    paper: Annotated[
        Paper,
        typer.Argument(metavar="PAPER", help="**pfnn**, **nnhpff**, **stdcl**, **cspf**, **marl**"),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for report and store.")],
    part: Annotated[
        Part,
        typer.Option(
            help="The paper's own tables and figures, the study beyond (of **stdcl**: stress, the "
            "learned part, campus flights, recordings; of **cspf**: recordings), or all."
        ),
    ] = Part.all,
    runs: Annotated[
        int | None,
        typer.Option(
            help="Worlds: 20 for **pfnn** (figure 9: 30), 100 for nnhpff and cspf, 50 for stdcl "
            "(a tenth beyond its main table), 40 for marl."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the first world.")] = 0,
    agents: Annotated[
        str | None,
        typer.Option(metavar="A,B,C", help="These agents only; others' figures stay empty."),
    ] = None,
    variants: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,C",
            help="These variants only; of **pfnn** those beyond the paper, of **marl** trainings.",
        ),
    ] = None,
    report_only: Annotated[
        bool, typer.Option("--report-only", help="Fly nothing: report what DIR/store has.")
    ] = False,
    steps: Annotated[
        int | None, typer.Option(help="Cut runs to so many steps: for a quick look.")
    ] = None,
    jobs: Annotated[int, typer.Option(help="Processes at once, of one thread each.")] = 1,
    fresh: Annotated[bool, typer.Option("--fresh", help="Throw the store away first.")] = False,
    data: Annotated[
        Path | None,
        typer.Option("--data", metavar="DIR", help="Folder of recordings (sets COLOC_DATA)."),
    ] = None,
) -> None:
    """Run a paper's experiments, and write its tables and figures with its numbers beside ours.

    What is done is kept in DIR/store at once: the same command, or one for another part, goes on
    where the last one stopped. Other settings, other code and other weights make other entries, so
    nothing is ever mixed. DIR/report.md says what became of every claim.

    **marl** is no paper: it trains policies with five seeds each (DIR/runs, resumed where they
    stopped) and flies them beside the filters in 40 worlds; --agents, --part and --steps are not
    for it.

    **Examples**

    coloc reproduce pfnn --out results/pfnn --jobs 2

    coloc reproduce pfnn --out results/quick --part paper --runs 4 --steps 200

    coloc reproduce pfnn --out results/pfnn --part robustness --agents ekf,ekf_trust
    --variants default,nlos,hard

    coloc reproduce nnhpff --out results/nnhpff --jobs 2

    coloc reproduce stdcl --out results/stdcl --jobs 2

    coloc reproduce stdcl --out results/stdcl --part stress --variants nlos-0.15,nlos-0.5

    coloc reproduce cspf --out results/cspf --jobs 2

    coloc reproduce marl --out results/marl --jobs 2
    """
    for name, value in (("runs", runs), ("steps", steps), ("jobs", jobs)):
        if value is not None and value < 1:
            raise ValueError(f"--{name} {value} is not allowed: at least 1")
    if not 0 <= seed < 2**62:
        raise ValueError(f"--seed {seed} is not allowed: a whole number from 0 to 2^62")
    if data is not None:
        os.environ["COLOC_DATA"] = str(data)
    # What MKL computes would else depend on where in memory it lies; said before it is first used.
    os.environ.setdefault("MKL_CBWR", "AUTO,STRICT")
    import torch

    from training.evaluation.evaluate import split_agents
    from training.reproduce.cspf.run import reproduce as run_cspf
    from training.reproduce.marl.run import reproduce as run_marl
    from training.reproduce.nnhpff.run import reproduce as run_nnhpff
    from training.reproduce.pfnn.run import reproduce as run_pfnn
    from training.reproduce.stdcl.run import reproduce as run_stdcl

    torch.set_num_threads(1)
    wanted = None if agents is None else split_agents(agents)
    where = None if variants is None else variants.split(",")
    if paper is Paper.marl and (agents or steps or part is not Part.all):
        raise ValueError("marl takes no --agents, --part or --steps")
    if paper in (Paper.nnhpff, Paper.stdcl) and agents:
        raise ValueError(f"{paper.value} takes no --agents")
    if part not in _PARTS[paper]:
        allowed = ", ".join(each.value for each in _PARTS[paper])
        raise ValueError(f"{paper.value} has no part {part.value!r}: {allowed} are allowed")
    if fresh:
        shutil.rmtree(out / "store", ignore_errors=True)
    fly, count = not report_only, runs or _RUNS[paper]
    with progress() as tell:
        if paper is Paper.marl:
            run_marl(out, count, seed, where, jobs, fly, tell, _say)
        elif paper is Paper.nnhpff:
            run_nnhpff(out, part.value, count, seed, where, steps, jobs, fly, tell, _say)
        elif paper is Paper.stdcl:
            run_stdcl(out, part.value, count, seed, where, steps, jobs, fly, tell, _say)
        elif paper is Paper.cspf:
            run_cspf(out, part.value, count, seed, wanted, where, steps, jobs, fly, tell, _say)
        else:
            run_pfnn(out, part.value, count, seed, wanted, where, steps, jobs, fly, tell, _say)
    typer.echo(f"written to {out}/report.md")


def _say(line: str) -> None:
    typer.echo(line, err=True)
