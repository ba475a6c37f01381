"""How agents look in all figures of this report."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from training.evaluation.figures import BOUND, log_axis
from training.reproduce.stdcl import plan
from training.reproduce.study import WORLD

# Colours that all eyes tell apart.
_LOOKS: dict[str, tuple[str, str, Any]] = {
    "mds": ("MDS-MAP", "#999999", "-"),
    "fcmds": ("FC-MDS", "#56B4E9", "-"),
    "dwmds": ("dwMDS", "#0072B2", "-"),
    "vmds": ("vMDS", "#009E73", "-"),
    plan.LEARNED: ("ST-GAT", "#CC79A7", "-"),
    plan.HUBER: ("DW-MDS, Huber", "#E69F00", (0, (4, 2))),
    plan.OPTIMIZER: ("DW-MDS, calibrated", "#E69F00", "-"),
    plan.WHOLE: ("ST-DCL", "#D55E00", "-"),
    f"{plan.OPTIMIZER}:confidence=none": ("DW-MDS, all alike", "#7F7F1F", (0, (4, 2))),
    f"{plan.OPTIMIZER}:confidence=paper": ("DW-MDS, the paper's", "#44AA99", "-"),
    "gn": ("Gauss–Newton", "#882255", (0, (1, 1.5))),
    "map": ("MAP, full covariance", "#332288", (0, (1, 1.5))),
    WORLD: ("INS alone", "#555555", (0, (1, 1.5))),
}
_OTHERS = ("#7F7F1F", "#44AA99", "#AA4499", "#661100", "#117733", "#88CCEE")
WITH_MOTION = BOUND | {"label": "bound with motion"}
OF_SNAPSHOT = BOUND | {"label": "CRLB of a snapshot", "linestyle": (0, (1, 2))}


def name(agent: str) -> str:
    """An agent's name in words, or as it is typed."""
    return _LOOKS[agent][0] if agent in _LOOKS else agent


def look(agent: str, index: int = 0) -> dict[str, Any]:
    """Colour, line and label."""
    words, colour, style = _LOOKS.get(agent, (agent, _OTHERS[index % len(_OTHERS)], "-"))
    width = 2.2 if agent == plan.WHOLE else 1.4
    return {"color": colour, "linestyle": style, "linewidth": width, "label": words}


def legend(figure: Figure, axes: Sequence[Axes], columns: int = 5) -> None:
    """One legend below all axes, each label once."""
    handles: dict[str, Any] = {}
    for each in axes:
        for handle, label in zip(*each.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=columns, fontsize=8.5
    )


def log(axes: Axes) -> None:
    """A logarithmic height with plain numbers, as high as the lines; intervals may go beyond."""
    heights = [np.asarray(line.get_ydata(), float) for line in axes.lines]
    known = np.concatenate([y[np.isfinite(y) & (y > 0)] for y in (*heights, np.zeros(0))])
    if known.size:
        axes.set_ylim(known.min() / 1.3, 1.3 * known.max())
    log_axis(axes.yaxis, axes.set_yscale)


def metres(axes: Axes, reach: float) -> None:
    """A scale of metres to the right of one of NRMSE."""
    if np.isfinite(reach):
        other = axes.secondary_yaxis("right", functions=(_times(reach), _times(1 / reach)))
        other.set_ylabel("RMSE (m)")
        other.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _times(factor: float) -> Callable[[Any], Any]:
    return lambda height: factor * np.asarray(height)
