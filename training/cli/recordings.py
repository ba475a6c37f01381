"""``coloc recordings``."""

import json
import os
from pathlib import Path
from shlex import quote
from typing import Annotated, Any, cast, get_args

import typer

from training.cli.options import Data, Seed, Threads, require_seed
from training.cli.terminal import progress, show


def recordings(
    agents: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,C",
            help="Measure these agents on every recording (**default**: the table's in docs).",
        ),
    ] = None,
    only: Annotated[
        str | None, typer.Option(metavar="A,B", help="Only these datasets; none: all.")
    ] = None,
    runs: Annotated[int, typer.Option(help="Draws of the prior, seeded SEED, SEED + 1, …")] = 3,
    seed: Seed = 0,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the table as JSON.")
    ] = None,
    leave_one_out: Annotated[
        bool,
        typer.Option(
            "--leave-one-out",
            help="For each dataset, which agent is best on the *others*, and its ratio to the "
            "better of **ekf** and **ekf:robust=huber** on it.",
        ),
    ] = False,
    constants: Annotated[
        str | None,
        typer.Option(
            metavar="WHICH",
            help="For each dataset, which constants are best on the *others*, and what they are "
            "worth on it: those of a **bank** (λ, ν, θ), or of considered **biases** (σ_b, τ).",
        ),
    ] = None,
    span: Annotated[
        str | None,
        typer.Option(metavar="FROM:TO", help="With --constants: only this part, in s."),
    ] = None,
    threads: Threads = 1,
    data: Data = None,
) -> None:
    """List the recordings in the data folder, or measure agents on all of them.

    A line a recording: the scenario that replays it, and whether constants were chosen on it.

    **Examples**

    coloc recordings --data ~/recordings

    coloc recordings --agents ekf,ekf:robust=huber,ekf_trust --runs 3 --out recordings.json

    coloc recordings --constants biases --span 0:120 --out biases.json
    """
    require_seed(seed)
    if runs < 1:
        raise ValueError(f"--runs {runs} is not allowed: at least 1")
    if data is not None:
        os.environ["COLOC_DATA"] = str(data)
    if constants is not None:
        _constants(constants, only, span, seed, out, threads)
        return
    if agents is None:
        _list()
        return
    from training.threads import use_threads

    use_threads(threads)
    from coloc_env.datasets import DATASETS
    from coloc_env.options import require_known
    from coloc_env.staging import require_writable
    from training.evaluation import recordings as all_of_them
    from training.evaluation.evaluate import split_agents

    require_known("dataset", None if only is None else only.split(","), DATASETS)
    require_writable(out)
    names = all_of_them.AGENTS if agents == "default" else tuple(split_agents(agents))
    figures: dict[str, dict[str, dict[str, object]]] = {}
    tuned: dict[str, bool] = {}
    with progress() as bars:
        for one in all_of_them.recorded():
            if only is not None and one.dataset not in only.split(","):
                continue
            scenario = one.scenario()
            name = f"{one.dataset}/{one.sequence}"
            tuned[name] = one.sequence in scenario.tuned_on
            figures[name] = all_of_them.measure(scenario, names, runs, seed, bars)
            command = f"coloc recordings --agents {quote(agents)} --runs {runs} --seed {seed}"
            table = all_of_them.table(
                figures, tuned, names, runs, seed, command, "measured by this command"
            )
            _write(table, out)  # what is measured so far, should the rest be stopped
    show(table["header"], table["rows"])
    if leave_one_out:
        chosen = all_of_them.chosen_elsewhere(figures, names)
        show(
            ["dataset", "chosen on the others", "× best classical"],
            [[key, agent, f"{ratio:.3f}"] for key, (agent, ratio) in chosen.items()],
        )


def _constants(
    which: str, only: str | None, span: str | None, seed: int, out: Path | None, threads: int
) -> None:
    """Measure how far constants carry."""
    from training.threads import use_threads

    use_threads(threads)
    from coloc_env.datasets import DATASETS
    from coloc_env.options import require_known
    from coloc_env.scenarios import parse_overrides
    from coloc_env.staging import require_writable
    from training.evaluation import constants

    if which not in get_args(constants.Which):
        raise ValueError(f"--constants {which} is not allowed: bank or biases")
    chosen = cast("constants.Which", which)
    datasets = None if only is None else only.split(",")
    require_known("dataset", datasets, DATASETS)
    require_writable(out)
    cut = {} if span is None else parse_overrides("replay-hanyang-v0", [f"span={span}"])
    with progress() as bars:
        found = constants.measure(chosen, datasets, seed, bars, **cut)
    command = f"coloc recordings --constants {which}"
    for name, value in (("only", only), ("span", span), ("seed", seed)):
        command += "" if value is None else f" --{name} {value}"
    table = constants.table(chosen, found, command, "measured by this command")
    _write(table, out)
    show(table["header"], table["rows"])


def _write(table: dict[str, Any], out: Path | None) -> None:
    """As JSON, where a file is wanted."""
    from coloc_env.staging import staged_file

    if out is None:
        return
    with staged_file(out) as file:
        file.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _list() -> None:
    from training.evaluation.recordings import recorded

    lines = []
    for one in recorded():
        tuned = "constants chosen on it" if one.sequence in one.scenario().tuned_on else ""
        lines.append([f"{one.dataset}/{one.sequence}", one.scenario_name, tuned])
    show(["recording", "scenario", ""], lines)
