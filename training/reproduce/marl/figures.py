"""Learning curves beside the filters and the bound."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from coloc_env.render.style import INK, MUTED
from training.evaluation.figures import STYLE
from training.evaluation.metrics import Floats
from training.reproduce.marl.plan import Trained
from training.reproduce.study import WORLD

_ACROSS = 4  # panels side by side
_LINES = {  # of the filters
    "ekf": (MUTED, ":"),
    "ekf:robust=huber": (MUTED, "--"),
    "ekf_trust": ("#009E73", "-."),
    "pf_trust": ("#D55E00", "-."),
}
_OWN = "#0072B2"
_TRIED = {"mixed": "default", "huber-nlos": "nlos", "huber-uwb": "uwb", "displacement": "default"}


def draw(
    planned: Sequence[Trained],
    curves: Mapping[str, Sequence[tuple[Floats, Floats]]],
    filters: Mapping[str, Mapping[str, float]],
    bounds: Mapping[str, float | None],
    file: Path,
) -> str:
    """Write the figure, a panel a training; its caption."""
    shown = [one for one in planned if curves[one.key]]
    rows = max(1, -(-len(shown) // _ACROSS))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(11.5, 0.6 + 2.5 * rows), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(rows, min(_ACROSS, max(1, len(shown))), squeeze=False)
        for axes in panels.flat[len(shown) :]:
            axes.set_visible(False)
        for axes, one in zip(panels.flat, shown, strict=False):
            for steps, error in curves[one.key]:
                axes.plot(steps / 1e6, error, color=_OWN, linewidth=1.0, alpha=0.55)
            where = _TRIED.get(one.key, one.key)
            if one.key != "mixed":
                for name, (colour, style) in _LINES.items():
                    if name in filters.get(where, {}):
                        axes.axhline(filters[where][name], color=colour, ls=style, lw=1.2)
                if bounds.get(where):
                    axes.axhline(bounds[where], color=INK, linewidth=1.2)
                if WORLD in filters.get(where, {}):
                    words = f"dead reckoning: {filters[where][WORLD]:.0f} m"
                    axes.text(0.98, 0.95, words, transform=axes.transAxes, ha="right", va="top",
                              fontsize=8, color=MUTED)  # fmt: skip
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
            axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if _few(value) else "")
            axes.tick_params(axis="y", which="minor", labelsize=8)
            axes.set_title(one.title, fontsize=8.5, loc="left")
            axes.set_xlim(left=0)
        figure.supxlabel("agent-steps (million)", fontsize=9)
        figure.supylabel("mean error in flight (m)", fontsize=9)
        handles = [
            mpl.lines.Line2D([], [], color=c, ls=s, label=label)
            for label, (c, s) in {
                "training seeds": (_OWN, "-"),
                **_LINES,
                "posterior bound (an RMSE)": (INK, "-"),
            }.items()
        ]
        figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=8.5)
        figure.savefig(file, dpi=150)
    return (
        "Mean error in flight, exploration included, over agent-steps; a line a training seed. "
        "Filters, and the bound as an RMSE, over runs of 20 s."
    )


def _few(value: float) -> bool:
    """Whether a minor tick is worth a label: twos and fives."""
    digit = round(value / 10 ** np.floor(np.log10(value)))
    return digit in (2, 5)
