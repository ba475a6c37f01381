"""The paper's figures 4 to 8, and ours of the detector and of kidnapping."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from coloc_env.render.style import MUTED
from training.evaluation.metrics import Floats
from training.reproduce.drawing import panels
from training.reproduce.nnhpff.claims import FAILED
from training.reproduce.nnhpff.detection import calibration, curve
from training.reproduce.nnhpff.flown import Detections
from training.reproduce.nnhpff.measures import Runs
from training.reproduce.verdicts import interval

# Colours that all eyes tell apart, the same in every figure.
_COLOURS = {"pf": "#0072B2", "hpff": "#E69F00", "nnhpff": "#D55E00", "ekf": "#009E73"}
_OTHERS = ("#CC79A7", "#56B4E9", "#882255", "#7F7F1F", "#332288", "#AA4499", "#999999")
_NAMES = {"pf": "PF", "hpff": "HPFF", "nnhpff": "NN-HPFF"}


def learning(samples: Floats) -> Figure:
    """Figure 4: cross-entropy of the detector on worlds of the 27 scenarios before it is trained on
    them, over samples seen."""
    figure, ((axes,),) = panels(1, 1, (6.0, 3.2), "Learning the failures of the particle filter")
    axes.plot(samples[:, 0] / 1e3, samples[:, 1], color=_COLOURS["nnhpff"], marker=".")
    axes.set(xlabel="samples (thousands)", ylabel="cross-entropy", yscale="log")
    return figure


def case(title: str, there: Mapping[str, Runs]) -> Figure:
    """Figures 5 to 7: (a) trajectories of the first run, (b) mean error over time, (c, d) share of
    runs in which the particle filter is begun anew at a step."""
    figure, grid = panels(2, 2, (9.5, 6.6), title)
    (path, error), (first, second) = grid
    results = next(iter(there.values())).results
    truth, time = results.worlds.truth[0, :, 0], _time(results.worlds.truth.shape[1], results.dt)
    path.plot(truth[:, 0], truth[:, 1], color="black", linewidth=1.0, label="truth")
    for i, (agent, one) in enumerate(there.items()):
        look = _look(agent, i)
        place = truth + one.one.offset[0, :, 0]
        path.plot(place[:, 0], place[:, 1], linewidth=1.0, **look)
        error.plot(time, one.error.mean((0, 2)), linewidth=1.3, **look)
    arena = results.scenario.arena
    path.set(xlim=(arena.low[0], arena.high[0]), ylim=(arena.low[1], arena.high[1]))
    path.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="a  trajectories of one run")
    path.legend(fontsize=8, loc="center")
    error.axhline(FAILED, color=MUTED, linewidth=0.8, linestyle=":")
    error.set(xlabel="time (s)", ylabel="error (m)", title=f"b  error, mean of {results.runs} runs")
    error.set_ylim(0.0, _calm_top([one.error.mean((0, 2)) for one in there.values()]))
    for axes, agent, letter in ((first, "hpff", "c"), (second, "nnhpff", "d")):
        axes.set_title(f"{letter}  resets of {_NAMES[agent]}")
        axes.set(xlabel="time (s)", ylabel="runs reset (%)", xlim=(0, time[-1]), ylim=(0, 100))
        if agent in there:
            share = 100 * there[agent].resets.mean((0, 2))
            axes.vlines(time, 0, share, color=_COLOURS[agent], linewidth=1.0)
    return figure


def ales(cases: Mapping[str, Mapping[str, Runs]]) -> Figure:
    """Figure 8: averaged localization error of each case, with 95 % intervals over runs."""
    figure, ((axes,),) = panels(1, 1, (7.5, 3.6), "Averaged localization error")
    agents = list(dict.fromkeys(agent for there in cases.values() for agent in there))
    width = 0.8 / max(1, len(agents))
    for i, agent in enumerate(agents):
        at, mean, half = [], [], []
        for j, there in enumerate(cases.values()):
            if agent in there:
                found = interval(there[agent].ale())
                at.append(j + (i - 0.5 * (len(agents) - 1)) * width)
                mean.append(found.mean)
                half.append(min(found.mean - found.low, 10.0))
        look = _look(agent, i)
        axes.bar(at, mean, 0.92 * width, color=look["color"], label=look["label"])
        axes.errorbar(at, mean, half, fmt="none", ecolor="black", elinewidth=0.9)
    axes.set_xticks(range(len(cases)), list(cases))
    axes.set_ylabel("ALE (m)")
    axes.legend(fontsize=8, ncols=2)
    return figure


def detector(samples: Mapping[str, Detections]) -> Figure:
    """The network as a detector: ROC (solid: network, dashed: Mahalanobis distance alone),
    precision and recall, and whether its probability is one."""
    figure, ((roc, precision, sure),) = panels(1, 3, (11.0, 3.8), "Detecting failures")
    for i, (title, group) in enumerate(samples.items()):
        colour = _OTHERS[i % len(_OTHERS)]
        for score, style in ((group.probability, "-"), (group.distance, "--")):
            drawn = curve(score, group.failed)
            words = f"{title}: {drawn.auc:.3f}" if style == "-" else f"d alone: {drawn.auc:.3f}"
            look: dict[str, Any] = {"color": colour, "linestyle": style, "linewidth": 1.3}
            roc.plot(drawn.false_alarms, drawn.hits, label=words, **look)
            precision.plot(drawn.hits[1:], drawn.precision[1:], **look)
        told = calibration(group.probability, group.failed)
        sure.plot(told.said, told.failed, marker="o", markersize=3.5, color=colour, label=title)
    sure.plot((0, 1), (0, 1), color=MUTED, linewidth=0.8, linestyle=":")
    roc.set(xlabel="false alarms", ylabel="failures found", xlim=(-0.02, 1), ylim=(0, 1.02))
    precision.set(xlabel="recall", ylabel="precision", xlim=(0, 1.02), ylim=(0, 1.02))
    sure.set(xlabel="probability said", ylabel="share that failed", xlim=(0, 1), ylim=(0, 1))
    roc.legend(fontsize=7.5, loc="lower right", title="ROC area", title_fontsize=8)
    return figure


def kidnapping(found: Mapping[str, tuple[Mapping[str, Runs], int, slice]]) -> Figure:
    """Median error of the UAVs that are put somewhere else at time 0, over all runs; bands:
    quartiles."""
    count = len(found)
    figure, grid = panels(1, count, (3.2 * count + 1.0, 3.8), "Kidnapped", sharey=True)
    for axes, (title, (there, step, uavs)) in zip(grid[0], found.items(), strict=True):
        shown = slice(max(0, step - 20), step + 120)
        for i, (agent, one) in enumerate(there.items()):
            error = one.error[:, shown, uavs].swapaxes(1, 2).reshape(-1, len(one.error[0, shown]))
            time = one.results.dt * (np.arange(error.shape[1]) + shown.start - step)
            look = _look(agent, i)
            low, middle, high = np.percentile(error, (25, 50, 75), axis=0)
            axes.fill_between(time, low, high, color=look["color"], alpha=0.15, linewidth=0)
            axes.plot(time, middle, linewidth=1.4, **look)
        axes.axhline(FAILED, color=MUTED, linewidth=0.8, linestyle=":")
        axes.set(xlabel="time after it (s)", yscale="log")
        axes.set_title(title, fontsize=9)
        axes.legend(fontsize=7)
    grid[0][0].set_ylabel("error (m)")
    return figure


def _look(agent: str, index: int) -> dict[str, Any]:
    colour = _COLOURS.get(agent, _OTHERS[index % len(_OTHERS)])
    return {"color": colour, "label": _NAMES.get(agent, agent)}


def _time(steps: int, dt: float) -> Floats:
    return dt * np.arange(steps)


def _calm_top(errors: Sequence[Floats]) -> float:
    """An upper end for errors over time that the first second, which knows nothing, may exceed."""
    late = [float(error[10:].max()) if len(error) > 10 else float(error.max()) for error in errors]
    return 1.15 * max(late)
