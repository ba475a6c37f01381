"""``coloc dataset``."""

from pathlib import Path
from typing import Annotated

import typer

from training.cli.options import (
    Data,
    ScenarioName,
    Seed,
    Settings,
    Threads,
    build_scenario,
    require_seed,
)
from training.cli.terminal import progress


def dataset(
    scenario: ScenarioName,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the dataset.")],
    runs: Annotated[int, typer.Option(help="Worlds, seeded SEED, SEED + 1, …")] = 100,
    seed: Seed = 0,
    steps: Annotated[
        int | None, typer.Option(help="Steps of each run; the scenario's if none.")
    ] = None,
    agent: Annotated[
        str | None,
        typer.Option(help="Who estimates; nobody, and no actions, rewards or messages, if none."),
    ] = None,
    settings: Settings = None,
    threads: Threads = 1,
    data: Data = None,
) -> None:
    """Write runs for learning elsewhere: what UAVs observe and the truth, as Parquet and as
    memory-mapped TensorDicts, with a card.

    DIR receives steps, worlds and tensordict, in parts of about 64 MB, dataset.json and README.md.
    Each part is written whole or not at all: the same command goes on where it was interrupted.

    **Examples**

    coloc dataset indoor-v0 --runs 1000 --out datasets/indoor

    coloc dataset indoor-v0 --runs 200 --agent ekf --set tdoa_anchors=8 --set landmarks=0
    --out datasets/tdoa
    """
    require_seed(seed)
    built = build_scenario(scenario, settings, threads, data)
    from training.dataset.plan import Plan
    from training.dataset.write import write_dataset

    plan = Plan(built, runs, seed, built.horizon if steps is None else steps, agent)
    with progress() as bars:
        write_dataset(plan, out, bars)
    typer.echo(f"written to {out}: {runs} runs in {plan.count} parts")
