"""``coloc report``."""

from pathlib import Path
from typing import Annotated

import typer


def report(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of evaluations.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The page, FILE.html.")] = Path(
        "report.html"
    ),
) -> None:
    """Make one HTML file about evaluations: it needs no network and no server.

    A table that sorts, errors and NEES over time, distributions, the first run in 3-D with
    ellipsoids and links, the worst moments, and the command that repeats each evaluation; several
    evaluations side by side. Needs the extra **report** (plotly).

    **Examples**

    coloc report results/indoor

    coloc report results/indoor results/hard --out comparison.html
    """
    if out.suffix.lower() != ".html":
        raise ValueError(f"--out {out} is not allowed: a name ending in .html")
    from coloc_env.staging import recover, require_writable, staged_file
    from training.evaluation.report.page import page
    from training.evaluation.runs import read

    require_writable(out)
    for folder in runs:
        recover(folder)
    text = page([read(folder) for folder in runs])
    with staged_file(out) as file:
        file.write_text(text, encoding="utf-8")
    typer.echo(f"written to {out}")
