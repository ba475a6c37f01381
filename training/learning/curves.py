"""A run's learning curves: all metrics as one JSON file, and a picture beside it."""

import json
from pathlib import Path

from matplotlib.figure import Figure

from coloc_env.staging import staged_file
from training.learning.logger import FOLDERS

JSON, PICTURE = "curves.json", "curves.png"
_SHOWN = ("return", "rmse", "error")  # what a picture shows, the first that a run has; else losses

Curve = list[tuple[int, float]]


def read(folder: Path) -> dict[str, Curve]:
    """Every metric of a run's folder, by name: [(frames, value), …]."""
    scalars = folder / FOLDERS[0] / "scalars"
    found = {}
    for file in sorted(scalars.glob("**/*.csv")):
        lines = (line.split(",") for line in file.read_text().splitlines())
        name = str(file.relative_to(scalars).with_suffix(""))
        found[name] = [(int(frames), float(value)) for frames, value in lines]
    return found


def write(folder: Path, title: str) -> None:
    """Write ``curves.json`` (a metric: a list of [frames, value]; NaN and infinity as null) and
    ``curves.png`` into a run's folder."""
    curves = read(folder)
    finite = {
        name: [(frames, value if value - value == 0 else None) for frames, value in curve]
        for name, curve in curves.items()
    }
    with staged_file(folder / JSON) as staged:
        staged.write_text(json.dumps(finite) + "\n", encoding="utf-8")
    if curves:
        with staged_file(folder / PICTURE) as staged:
            picture(curves, title).savefig(staged, format="png", dpi=110)


def picture(curves: dict[str, Curve], title: str) -> Figure:
    """The run's most telling metric over frames; its losses, where it has none."""
    shown = [name for name in _SHOWN if name in curves][:1]
    shown = shown or [name for name in curves if name.startswith("loss")] or list(curves)[:1]
    figure = Figure(figsize=(6, 3.4), layout="constrained")
    axes = figure.add_subplot(title=title, xlabel="frames", ylabel=shown[0])
    for name in shown:
        axes.plot(*zip(*curves[name], strict=True), label=name)
    if len(shown) > 1:
        axes.set_ylabel("")
        axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return figure
