"""How agents are drawn in all figures of this study, and what the figures share."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from coloc_env.bounds import Bound
from training.evaluation import metrics
from training.evaluation.figures import BOUND, log_axis
from training.evaluation.metrics import Difference
from training.reproduce.drawing import seconds
from training.reproduce.measures import per_step, rmse, rmse_of_bound
from training.reproduce.results import Results, Runs
from training.reproduce.stdcl import plan
from training.reproduce.stdcl.measures import nrmse, radius
from training.reproduce.verdicts import interval
from training.reproduce.work import POSTERIOR, SNAPSHOT, WORLD

# Colours that all eyes distinguish.
_STYLES: dict[str, tuple[str, str, Any]] = {
    "mds": ("MDS-MAP", "#999999", "-"),
    "fcmds": ("FC-MDS", "#56B4E9", "-"),
    "dwmds": ("dwMDS", "#0072B2", "-"),
    "vmds": ("vMDS", "#009E73", "-"),
    plan.LEARNED: ("ST-GAT", "#CC79A7", "-"),
    plan.HUBER: ("DW-MDS, Huber", "#E69F00", (0, (4, 2))),
    plan.OPTIMIZER: ("DW-MDS, calibrated", "#E69F00", "-"),
    plan.WHOLE: ("ST-DCL, calibrated", "#D55E00", "-"),
    f"{plan.OPTIMIZER}:confidence=none": ("DW-MDS, all alike", "#7F7F1F", (0, (4, 2))),
    f"{plan.OPTIMIZER}:confidence=paper": ("DW-MDS, the paper's", "#44AA99", "-"),
    "gn": ("Gauss–Newton", "#882255", (0, (1, 1.5))),
    "map": ("MAP, full covariance", "#332288", (0, (1, 1.5))),
    WORLD: ("INS alone", "#555555", (0, (1, 1.5))),
}
_OTHERS = ("#7F7F1F", "#44AA99", "#AA4499", "#661100", "#117733", "#88CCEE")
_BOUNDS = (
    (POSTERIOR, BOUND | {"label": "bound with motion"}),
    (SNAPSHOT, BOUND | {"label": "CRLB of a snapshot", "linestyle": (0, (1, 2))}),
)
SHOWN = (*plan.METHODS, *plan.REFERENCES, WORLD)
Teams = Mapping[str, Runs]  # by agent


def shown(results: Results, key: str) -> Teams:
    """The agents that figures show."""
    return results.runs(key, SHOWN)


def name(agent: str) -> str:
    """An agent's name in words, or as it is typed."""
    return _STYLES[agent][0] if agent in _STYLES else agent


def style_of(agent: str, index: int = 0) -> dict[str, Any]:
    """Colour, line and label."""
    words, colour, line = _STYLES.get(agent, (agent, _OTHERS[index % len(_OTHERS)], "-"))
    width = 2.2 if agent == plan.WHOLE else 1.4
    return {"color": colour, "linestyle": line, "linewidth": width, "label": words}


def log(axes: Axes) -> None:
    """A logarithmic height with plain numbers, as high as the lines; intervals may go beyond."""
    heights = [np.asarray(line.get_ydata(), float) for line in axes.lines]
    known = np.concatenate([y[np.isfinite(y) & (y > 0)] for y in (*heights, np.zeros(0))])
    if known.size:
        axes.set_ylim(known.min() / 1.3, 1.3 * known.max())
    log_axis(axes.yaxis, axes.set_yscale)


def metres(axes: Axes, found: Sequence[Teams]) -> None:
    """A scale of metres to the right of one of NRMSE."""
    reach = next((radius(one) for there in found for one in there.values()), float("nan"))
    if np.isfinite(reach):
        other = axes.secondary_yaxis("right", functions=(_times(reach), _times(1 / reach)))
        other.set_ylabel("RMSE (m)")
        other.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _times(factor: float) -> Callable[[Any], Any]:
    return lambda height: factor * np.asarray(height)


def spread(x: Difference) -> tuple[float, float]:
    """How far an interval reaches below and above its mean; 0 where it is infinite."""
    reach = (x.mean - x.low, x.high - x.mean)
    return reach if np.isfinite(reach).all() else (0.0, 0.0)


def curves(axes: Axes, results: Results, keys: Mapping[float, str], scaled: bool,
           agents: Sequence[str] = SHOWN) -> None:  # fmt: skip
    """Agents' RMSE, or NRMSE, with 95 % intervals over a quantity, and the bounds'."""
    found = {x: results.runs(key, agents) for x, key in keys.items()}
    measure = nrmse if scaled else rmse
    every = dict.fromkeys(agent for there in found.values() for agent in there)
    for i, agent in enumerate(every):
        own = {x: interval(measure(t[agent])) for x, t in found.items() if agent in t}
        half = np.transpose([spread(each) for each in own.values()])
        heights, style = [each.mean for each in own.values()], style_of(agent, i)
        axes.errorbar(list(own), heights, half, marker=".", elinewidth=0.8, **style)
    for kind, style in _BOUNDS:
        known: dict[float, float] = {}
        for x, there in found.items():
            bound: Bound | None = results.get(keys[x], "", kind)
            if bound is not None and there:
                reach = radius(next(iter(there.values()))) if scaled else 1.0
                known[x] = rmse_of_bound(bound) / reach
        axes.plot(list(known), list(known.values()), **style)
    log(axes)


def over_time(axes: Axes, results: Results, key: str) -> None:
    """NRMSE over time with its bounds."""
    there = shown(results, key)
    for i, (agent, one) in enumerate(there.items()):
        heights = per_step(one)
        axes.plot(seconds(heights, one.dt), heights / radius(one), **style_of(agent, i))
    for kind, style in _BOUNDS:
        bound: Bound | None = results.get(key, "", kind)
        if bound is not None and there:
            one = next(iter(there.values()))
            counts = (bound.scored & bound.mse.isfinite()).numpy()
            heights = metrics.rmse_per_step(bound.mse.sqrt().numpy(), counts) / radius(one)
            axes.plot(seconds(heights, one.dt), heights, **style)
    axes.set(xlabel="time (s)")
    log(axes)
