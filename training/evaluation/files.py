"""The folder of an evaluation: JSON, CSV, Markdown, TUM files and figures."""

import json
from pathlib import Path

from coloc_env.staging import staged_file
from training.evaluation import runs
from training.evaluation.results import Evaluation
from training.evaluation.tables import csv_text, markdown
from training.evaluation.tum import write_tum

FIGURES = ("error_over_time.png", "cdf.png", "boxes.png", "nees.png", "trajectories.png")
VECTORS = tuple(name.replace(".png", ".svg") for name in FIGURES)
REPORT = "report.html"
WRITTEN = ("results.csv", "table.md", *FIGURES, "tum", runs.FILE, "results.json")
NAMES = (REPORT, *VECTORS, *WRITTEN)  # all that may be there; the last marks a whole folder


def write(results: Evaluation, folder: Path) -> None:
    """Write everything but figures into an empty folder (a staged one: ``coloc_env.staging``)."""
    text = json.dumps(results.summary, indent=2, allow_nan=False, ensure_ascii=False)
    (folder / "results.json").write_text(text + "\n", encoding="utf-8")
    (folder / "results.csv").write_text(csv_text(results), encoding="utf-8")
    (folder / "table.md").write_text(markdown(results), encoding="utf-8")
    write_tum(results, folder / "tum")
    runs.write(runs.of(results, ""), folder)


def write_report(results: Evaluation, name: str, folder: Path) -> None:
    """Write the page about the evaluation ``name``. ValueError where plotly is not installed."""
    from training.evaluation.report.page import page

    text = page([runs.of(results, name)])
    with staged_file(folder / REPORT) as file:
        file.write_text(text, encoding="utf-8")


def write_figures(results: Evaluation, folder: Path, vector: bool = False) -> None:
    """Draw all figures into the folder as PNG or, ``vector``, SVG; none if that raises."""
    names = VECTORS if vector else FIGURES
    try:
        from training.evaluation.figures import draw

        draw(results, folder, names)
    except BaseException:
        for name in names:
            (folder / name).unlink(missing_ok=True)
        raise
