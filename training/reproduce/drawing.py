"""What figures of studies have in common."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from training.evaluation.figures import STYLE
from training.evaluation.metrics import Floats
from training.reproduce.results import Results

Drawing = Callable[[Results], Figure | None]  # its docstring is the caption; None: nothing to draw
# Colours that all eyes distinguish.
PALETTE = ("#CC79A7", "#56B4E9", "#882255", "#7F7F1F", "#332288", "#AA4499", "#999999", "#44AA99")


def draw(drawing: Drawing, results: Results, file: Path) -> str | None:
    """Write a PNG that cuts nothing off; the caption, or None if there was nothing to draw."""
    with mpl.rc_context(STYLE):
        figure = drawing(results)
        if figure is None:
            return None
        page = Bbox.union([figure.bbox_inches, figure.get_tightbbox()])
        figure.savefig(file, dpi=150, bbox_inches=page)
    return " ".join((drawing.__doc__ or "").split())


def headline(figure: Figure, title: str) -> None:
    """The title of a figure."""
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold")


def panels(
    rows: int,
    columns: int,
    size: tuple[float, float],
    title: str,
    *,
    sharex: bool = False,
    sharey: bool = False,
) -> tuple[Figure, list[list[Axes]]]:
    """A titled figure of ``size`` inches with a grid of axes."""
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    headline(figure, title)
    grid = figure.subplots(rows, columns, squeeze=False, sharex=sharex, sharey=sharey)
    return figure, [list(row) for row in grid]


def legend(figure: Figure, axes: Sequence[Axes], columns: int = 5) -> None:
    """One legend below all axes, each label once."""
    handles: dict[str, Any] = {}
    for each in axes:
        for handle, label in zip(*each.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=columns, fontsize=8.5
    )


def seconds(values: Floats, dt: float) -> Floats:
    """Times of steps."""
    return dt * np.arange(len(values))
