"""The paper's figure 4 over many runs, and convergence and error against the share of outliers."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from training.evaluation.metrics import Floats
from training.reproduce.cspf import plan
from training.reproduce.cspf.measures import Runs
from training.reproduce.drawing import panels
from training.reproduce.verdicts import share

# Colours that all eyes tell apart, the same in every figure.
_COLOURS = ("#D55E00", "#E69F00", "#CC79A7", "#0072B2", "#009E73", "#56B4E9", "#332288", "#999999")


def over_time(found: Mapping[str, Mapping[str, Runs]]) -> Figure:
    """Share of the runs in which every holder's pose of every UAV is within 0.3 m and 10°, over
    steps, at the paper's share of outliers (its figure 4 shows one run)."""
    figure, (axes,) = panels(
        1, len(found), (4.8 * len(found), 3.4), "Convergence, a fifth of all matches wrong"
    )
    for one, (title, there) in zip(axes, found.items(), strict=True):
        for i, (agent, runs) in enumerate(there.items()):
            one.plot(100 * runs.over_time(), linewidth=1.4, **_look(agent, i))
        one.set(xlabel="step", ylabel="runs converged (%)", ylim=(-3, 103), title=title)
    axes[0].legend(fontsize=7, loc="center right")
    return figure


def over_shares(found: Mapping[tuple[int, float], Mapping[str, Runs]]) -> Figure:
    """Above: share of the runs converged after 150 steps, with exact 95 % intervals; below: median
    of the worst error over holders and UAVs; against the share of wrong matches."""
    dims = sorted({dim for dim, _ in found})
    figure, rows = panels(2, len(dims), (4.8 * len(dims), 6.0), "How many wrong matches it takes")
    for column, dim in enumerate(dims):
        there = {s: runs for (d, s), runs in found.items() if d == dim}
        for i, agent in enumerate(plan.METHODS):
            have = [s for s in there if agent in there[s]]
            if not have:
                continue
            hits = [share(there[s][agent].converged(plan.EARLY)) for s in have]
            middle = np.array([each.mean for each in hits])
            reach = np.array([(h.mean - h.low, h.high - h.mean) for h in hits]).T
            worst = [float(np.median(there[s][agent].worst(plan.EARLY))) for s in have]
            at: Floats = np.array(have) + 0.003 * (i - 2)
            look = _look(agent, i)
            rows[0][column].errorbar(at, middle, reach, marker="o", markersize=3, **look)
            rows[1][column].plot(at, worst, marker="o", markersize=3, **look)
        rows[0][column].set(ylabel="runs converged (%)", ylim=(-3, 103), title=f"{dim}-D")
        rows[1][column].set(ylabel="worst error (m)", xlabel="share of outliers", yscale="log")
    rows[0][0].legend(fontsize=7, loc="lower left")
    return figure


def _look(agent: str, index: int) -> dict[str, Any]:
    return {"label": plan.NAMES.get(agent, agent), "color": _COLOURS[index % len(_COLOURS)]}
