"""What figures of reports have in common."""

from collections.abc import Callable, Mapping
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from training.evaluation.figures import STYLE


def save(drawing: Callable[[], Figure], file: Path) -> None:
    """Draw in the house's style and write a PNG that cuts nothing off."""
    with mpl.rc_context(STYLE):
        figure = drawing()
        page = Bbox.union([figure.bbox_inches, figure.get_tightbbox()])
        figure.savefig(file, dpi=150, bbox_inches=page)


def caption(drawing: Callable[..., Figure]) -> str:
    """A drawing's docstring, as what stands below it."""
    return " ".join((drawing.__doc__ or "").split())


def draw(drawings: Mapping[str, Callable[[], Figure]], folder: Path) -> list[str]:
    """Write figures; the lines that show them, each drawing's docstring as its caption."""
    text: list[str] = []
    for name, drawn in drawings.items():
        save(drawn, folder / name)
        words = caption(getattr(drawn, "func", drawn))
        text += [f"![{words}]({name})", "", f"*{words}*", ""]
    return text


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
