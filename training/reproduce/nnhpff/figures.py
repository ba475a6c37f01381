"""The paper's figures 4 to 8, and ours of the detector and of kidnapping."""

from collections.abc import Sequence
from functools import partial, update_wrapper
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from coloc_env.render.style import MUTED
from training.evaluation.metrics import Floats
from training.learning.nnhpff import FAILED
from training.reproduce.drawing import PALETTE, Drawing, panels, seconds
from training.reproduce.measures import mean_error
from training.reproduce.nnhpff import plan
from training.reproduce.nnhpff.detection import calibration, curve
from training.reproduce.nnhpff.tables import detections, kidnapped
from training.reproduce.results import Results
from training.reproduce.verdicts import interval

# Colours that all eyes distinguish, the same in every figure.
_COLOURS = {
    "pf": "#0072B2",
    "hpff:bank=false": "#E69F00",
    "nnhpff:bank=false": "#D55E00",
    "ekf": "#009E73",
    plan.RESIDUALS: "#CC79A7",
}
_NAMES = {
    "pf": "PF",
    "hpff:bank=false": "HPFF",
    "nnhpff:bank=false": "NN-HPFF",
    plan.RESIDUALS: "HPFF, Σr²",
}


def learning(results: Results) -> Figure | None:
    """Figure 4: cross-entropy of the detector on worlds of the 27 scenarios before it is trained on
    them, over samples seen."""
    folder = plan.LEARNING.folder(results.settings.out)
    file = folder / "metrics" / "scalars" / "held_out_loss.csv"
    if not file.is_file():
        return None
    samples = np.loadtxt(file, delimiter=",", ndmin=2)
    figure, ((axes,),) = panels(1, 1, (6.0, 3.2), "Learning the failures of the particle filter")
    axes.plot(samples[:, 0] / 1e3, samples[:, 1], color=_COLOURS["nnhpff:bank=false"], marker=".")
    axes.set(xlabel="samples (thousands)", ylabel="cross-entropy", yscale="log")
    return figure


def case(number: int, results: Results) -> Figure | None:
    """(a) Trajectories of the first run, (b) mean error over time, (c, d) share of runs in which
    the particle filter is restarted at a step."""
    there = results.runs(plan.case(number).key, plan.METHODS)
    if not there:
        return None
    first_one = next(iter(there.values()))
    title = plan.CASES[number]
    figure, grid = panels(2, 2, (9.5, 6.6), title[0].upper() + title[1:])
    (path, error), (first, second) = grid
    truth, time = first_one.truth[0, :, 0], seconds(first_one.truth[0], first_one.dt)
    path.plot(truth[:, 0], truth[:, 1], color="black", linewidth=1.0, label="truth")
    for i, (agent, one) in enumerate(there.items()):
        style = _style(agent, i)
        place = truth + one.record.offset[0, :, 0]
        path.plot(place[:, 0], place[:, 1], linewidth=1.0, **style)
        error.plot(time, one.error.mean((0, 2)), linewidth=1.3, **style)
    arena = first_one.evaluation.scenario.arena
    path.set(xlim=(arena.low[0], arena.high[0]), ylim=(arena.low[1], arena.high[1]))
    path.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="a  trajectories of one run")
    path.legend(fontsize=8, loc="center")
    error.axhline(FAILED, color=MUTED, linewidth=0.8, linestyle=":")
    error.set(
        xlabel="time (s)",
        ylabel="error (m)",
        title=f"b  error, mean of {len(first_one.error)} runs",
    )
    error.set_ylim(0.0, _calm_top([one.error.mean((0, 2)) for one in there.values()]))
    for axes, agent, letter in (
        (first, "hpff:bank=false", "c"),
        (second, "nnhpff:bank=false", "d"),
    ):
        axes.set_title(f"{letter}  resets of {_NAMES[agent]}")
        axes.set(xlabel="time (s)", ylabel="runs reset (%)", xlim=(0, time[-1]), ylim=(0, 100))
        if agent in there:
            share = 100 * plan.resets(there[agent]).mean((0, 2))
            axes.vlines(time, 0, share, color=_COLOURS[agent], linewidth=1.0)
    return figure


def errors(results: Results) -> Figure | None:
    """Figure 8: averaged localization error of each case, with 95 % intervals over runs."""
    agents_ = (*plan.METHODS, *plan.BESIDE)
    cases = {title: results.runs(plan.case(n).key, agents_) for n, title in plan.CASES.items()}
    if not any(cases.values()):
        return None
    figure, ((axes,),) = panels(1, 1, (7.5, 3.6), "Averaged localization error")
    agents = list(dict.fromkeys(agent for there in cases.values() for agent in there))
    width = 0.8 / max(1, len(agents))
    for i, agent in enumerate(agents):
        at, mean, half = [], [], []
        for j, there in enumerate(cases.values()):
            if agent in there:
                found = interval(mean_error(there[agent]))
                at.append(j + (i - 0.5 * (len(agents) - 1)) * width)
                mean.append(found.mean)
                half.append(min(found.mean - found.low, 10.0))
        style = _style(agent, i)
        axes.bar(at, mean, 0.92 * width, color=style["color"], label=style["label"])
        axes.errorbar(at, mean, half, fmt="none", ecolor="black", elinewidth=0.9)
    axes.set_xticks(range(len(cases)), list(cases))
    axes.set_ylabel("ALE (m)")
    axes.legend(fontsize=8, ncols=2)
    return figure


def detector(results: Results) -> Figure | None:
    """The network as a detector: ROC (solid: network, dotted: Σr² alone, dashed: Mahalanobis
    distance alone), precision and recall, and whether its probability is one."""
    samples = {
        title: group
        for title, group in detections(results).items()
        if 0 < group.failed.sum() < group.failed.size
    }
    if not samples:
        return None
    figure, ((roc, precision, sure),) = panels(1, 3, (11.0, 3.8), "Detecting failures")
    for i, (title, group) in enumerate(samples.items()):
        colour = PALETTE[i % len(PALETTE)]
        for (name, score), dash in zip(group.scores.items(), ("-", ":", "--"), strict=True):
            drawn = curve(score, group.failed)
            words = f"{title if name == 'network' else name}: {drawn.auc:.3f}"
            line: dict[str, Any] = {"color": colour, "linestyle": dash, "linewidth": 1.3}
            roc.plot(drawn.false_alarms, drawn.hits, label=words, **line)
            precision.plot(drawn.hits[1:], drawn.precision[1:], **line)
        bins = calibration(group.probability, group.failed)
        sure.plot(
            bins.probability, bins.failed, marker="o", markersize=3.5, color=colour, label=title
        )
    sure.plot((0, 1), (0, 1), color=MUTED, linewidth=0.8, linestyle=":")
    roc.set(xlabel="false alarms", ylabel="failures found", xlim=(-0.02, 1), ylim=(0, 1.02))
    precision.set(xlabel="recall", ylabel="precision", xlim=(0, 1.02), ylim=(0, 1.02))
    sure.set(xlabel="probability given", ylabel="share that failed", xlim=(0, 1), ylim=(0, 1))
    roc.legend(fontsize=7.5, loc="lower right", title="ROC area", title_fontsize=8)
    return figure


def kidnapping(results: Results) -> Figure | None:
    """Median error of the UAVs that are put somewhere else at time 0, over all runs; bands:
    quartiles."""
    found = kidnapped(results)
    if not found:
        return None
    count = len(found)
    figure, grid = panels(1, count, (3.2 * count + 1.0, 3.8), "Kidnapped", sharey=True)
    for axes, (title, (there, step, uavs)) in zip(grid[0], found.items(), strict=True):
        shown = slice(max(0, step - 20), step + 120)
        for i, (agent, one) in enumerate(there.items()):
            error = one.error[:, shown, uavs].swapaxes(1, 2).reshape(-1, len(one.error[0, shown]))
            time = one.dt * (np.arange(error.shape[1]) + shown.start - step)
            style = _style(agent, i)
            low, middle, high = np.percentile(error, (25, 50, 75), axis=0)
            axes.fill_between(time, low, high, color=style["color"], alpha=0.15, linewidth=0)
            axes.plot(time, middle, linewidth=1.4, **style)
        axes.axhline(FAILED, color=MUTED, linewidth=0.8, linestyle=":")
        axes.set(xlabel="time after it (s)", yscale="log")
        axes.set_title(title, fontsize=9)
        axes.legend(fontsize=7)
    grid[0][0].set_ylabel("error (m)")
    return figure


def _style(agent: str, index: int) -> dict[str, Any]:
    colour = _COLOURS.get(agent, PALETTE[index % len(PALETTE)])
    return {"color": colour, "label": _NAMES.get(agent, agent)}


def _calm_top(errors: Sequence[Floats]) -> float:
    """An upper end for errors over time that the first second, which knows nothing, may exceed."""
    late = [float(error[10:].max()) if len(error) > 10 else float(error.max()) for error in errors]
    return 1.15 * max(late)


def _of_case(number: int) -> Drawing:
    drawing: Any = update_wrapper(partial(case, number), case)
    drawing.__doc__ = f"Figure {4 + number}. {case.__doc__}"
    return drawing


PAPER: dict[str, Drawing] = {
    "figure_4_learning.png": learning,
    **{f"figure_{4 + n}_case_{n}.png": _of_case(n) for n in plan.CASES},
    "figure_8_ale.png": errors,
}
DETECTOR: dict[str, Drawing] = {"detector.png": detector}
BEYOND: dict[str, Drawing] = {"kidnapped.png": kidnapping}
