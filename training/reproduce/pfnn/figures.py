"""The paper's figures 2 to 9, redrawn from our runs."""

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.ndimage import uniform_filter1d

from coloc_env.render.style import INK, MUTED, rgb, uav_colours
from coloc_env.world import World
from training.evaluation import metrics
from training.evaluation.figures import BOUND, log_axis
from training.evaluation.metrics import Floats
from training.reproduce import drawing
from training.reproduce.measures import largest, rmse
from training.reproduce.pfnn import paper
from training.reproduce.pfnn.plan import ABLATION, DEFAULT, FIGURE_9, particles
from training.reproduce.results import Results, Runs
from training.reproduce.verdicts import interval

SHOWN = "pfnn"  # whose figures 3 to 8 are
_ACROSS = 3  # panels beside each other
_ACCENT, _CALM = rgb("#D55E00"), rgb("#8d9ab0")
_LINES = {  # figure 9b: as the paper's lines, in colours that all eyes distinguish
    "pfnn": {"color": "#009E73", "linestyle": "-", "linewidth": 2.4},
    "pf500": {"color": "#D55E00", "linestyle": "--", "linewidth": 1.6},
    "pf800": {"color": "#E69F00", "linestyle": "-.", "linewidth": 1.6},
    "apf": {"color": "#0072B2", "linestyle": ":", "linewidth": 2.0},
    "ekf": {"color": "#CC79A7", "linestyle": (0, (4, 1, 1, 1, 1, 1)), "linewidth": 1.6},
}


def ablation(results: Results) -> Figure | None:
    """Figure 2: ablation of the correction's range; dots: mean over runs, bars: 95 % interval."""
    there = results.runs(DEFAULT, list(ABLATION))
    if not there:
        return None
    count = len(next(iter(there.values())).error)
    title = f"Ablation of the correction's range · {count} runs"
    figure, panels = _panels(3, 3.6, title, sharey=True)
    row = paper.TABLE_4["pfnn"]
    assert row.particles is not None
    columns: tuple[tuple[str, Callable[[Runs], Floats], float], ...] = (
        ("RMSE (m)", rmse, row.rmse.mean),
        ("largest error (m)", largest, row.max.mean),
        ("average particles", particles, row.particles.mean),
    )
    for axes, (label, measure, theirs) in zip(panels, columns, strict=True):
        for i, (agent, one) in enumerate(there.items()):
            found = interval(measure(one))
            colour = _ACCENT if ABLATION[agent] == paper.PROPOSED else MUTED
            if np.isfinite(found.low):
                axes.plot([found.low, found.high], [i, i], color=colour, linewidth=2.5)
            axes.plot(found.mean, i, "o", color=colour)
        axes.set(xlabel=label)
        axes.set_title(f"paper, [0.4, 1.0]: {theirs:g}", fontsize=9, fontweight="normal")
        axes.margins(x=0.15)
        axes.locator_params(axis="x", nbins=4)
    spans = [ABLATION[agent] for agent in there]
    panels[0].set_yticks(range(len(spans)), [f"[{a}, {b}]" for a, b in spans])
    panels[0].set_ylim(len(spans) - 0.5, -0.5)
    return figure


def trajectories(results: Results) -> Figure | None:
    """Figure 3: trajectories of the first run; coloured: true, dashed: estimated, squares:
    landmarks."""
    one = results.get(DEFAULT, SHOWN)
    if one is None:
        return None
    world, truth = one.evaluation, one.truth[0]
    figure = Figure(figsize=(9.5, 5.6))
    FigureCanvasAgg(figure)
    axes: Any = figure.add_subplot(projection="3d")
    estimate = truth + one.record.offset[0]
    for i, colour in enumerate(_uavs(one)):
        axes.plot(*truth[:, i].T, color=colour, linewidth=1.0, label=_name(i))
        axes.plot(*estimate[:, i].T, "--", color=INK, linewidth=0.8)
    leaves = World(world.scenario, window=1).reset(world.seed).leaves
    if "landmark_map" in leaves:
        places = leaves["landmark_map"][0, 0].unflatten(-1, (-1, 3))
        axes.plot(*places.T.numpy(), "s", color="black", markersize=4, label="landmark")
    low, high = world.scenario.arena.low, world.scenario.arena.high
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    axes.locator_params(axis="y", nbins=4)
    axes.set_box_aspect((3.0, 2.0, 1.0), zoom=1.15)
    axes.view_init(elev=32, azim=-60)
    lines, _ = axes.get_legend_handles_labels()
    dashed = Line2D([], [], color=INK, linestyle="--", linewidth=0.8, label="estimate")
    figure.legend(handles=[*lines, dashed], loc="center right")
    figure.subplots_adjust(left=0.0, right=0.82, bottom=0.0, top=0.98)
    drawing.headline(figure, f"Trajectories · PF-NN, seed {world.seed}")
    return figure


def errors(results: Results) -> Figure | None:
    """Figure 4: position error over time; bold: root mean square over runs, thin: run 1, dashed:
    bound."""
    one = results.get(DEFAULT, SHOWN)
    if one is None:
        return None
    error, bound = one.error, one.evaluation.bound
    squares = np.sqrt(np.nanmean(np.where(one.scored, error, np.nan) ** 2, 0))
    figure, panels = _over_time(one, "Position error over time", "error (m)", error[0], squares)
    for i, axes in enumerate(panels):
        if bound is not None:
            axes.plot(_time(one), bound.position[:, i].numpy(), **BOUND)
        log_axis(axes.yaxis, axes.set_yscale)
    return figure


def bars(results: Results) -> Figure | None:
    """Figure 5: RMSE of each UAV, the paper's above ours (mean over runs; whiskers: standard
    deviation)."""
    one = results.get(DEFAULT, SHOWN)
    if one is None:
        return None
    figure, (axes,) = _panels(1, 3.8, f"RMSE of each UAV · PF-NN, {len(one.error)} runs")
    tracks = metrics.rmse_per_track(one.error, one.scored)
    ours, apart = tracks.mean(0), tracks.std(0)
    theirs = [row.rmse for name, row in paper.TABLE_3.items() if name != "Average"]
    at = np.arange(len(ours))
    few = min(len(theirs), len(ours))
    axes.barh(at[:few] - 0.2, theirs[:few], 0.38, color=_CALM)
    axes.barh(at + 0.2, ours, 0.38, color=_uavs(one), xerr=apart, error_kw={"ecolor": INK})
    for y, value in zip(at[:few] - 0.2, theirs, strict=False):
        axes.text(value, y, f" paper {value:.3f}", va="center", fontsize=8, color=MUTED)
    for y, value, spread in zip(at + 0.2, ours, apart, strict=True):
        axes.text(value + spread, y, f"  ours {value:.3f}", va="center", fontsize=8)
    axes.set_yticks(at, [_name(i) for i in range(len(at))])
    axes.set(xlabel="RMSE (m)", ylim=(len(ours) - 0.5, -0.5))
    axes.margins(x=0.12)
    axes.grid(False, axis="y")
    return figure


def boxes(results: Results) -> Figure | None:
    """Figure 6: position errors of each UAV, all steps and runs; box: quartiles, whiskers: 5 % to
    95 %, cross: the largest."""
    one = results.get(DEFAULT, SHOWN)
    if one is None:
        return None
    error = one.error
    figure, (axes,) = _panels(1, 3.8, f"Position errors · PF-NN, {len(error)} runs")
    for i, colour in enumerate(_uavs(one)):
        values, line = error[:, :, i][one.scored[:, :, i]], {"color": colour}
        axes.boxplot(
            [values],
            positions=[i],
            orientation="horizontal",
            widths=0.55,
            whis=(5, 95),
            showfliers=False,
            patch_artist=True,
            boxprops={"facecolor": (*colour, 0.2), "edgecolor": colour},
            medianprops=line | {"linewidth": 2},
            whiskerprops=line,
            capprops=line,
        )
        axes.plot(values.max(), i, "x", color=colour)
    axes.axvline(paper.MEDIAN, color=MUTED, linestyle=":", linewidth=1.3)
    axes.text(paper.MEDIAN, -0.62, " paper: medians below", fontsize=8, color=MUTED, va="top")
    axes.set_yticks(range(error.shape[2]), [_name(i) for i in range(error.shape[2])])
    axes.set(xlabel="position error (m)", ylim=(error.shape[2] - 0.5, -0.7))
    log_axis(axes.xaxis, axes.set_xscale)
    axes.grid(False, axis="y")
    return figure


def counts(results: Results) -> Figure | None:
    """Figure 7: particles over time; bold: mean over runs, thin: run 1, dotted: the 800 at which
    the paper's saturate."""
    one = results.get(DEFAULT, SHOWN)
    if one is None:
        return None
    count = one.record.series["particles"]
    mean = np.nanmean(count, 0)
    figure, panels = _over_time(one, "Particles over time", "particles", count[0], mean)
    for axes in panels:
        axes.axhline(paper.MAX_PARTICLES, color=MUTED, linestyle=":", linewidth=1.3)
        axes.set_ylim(0, 1.1 * paper.MAX_PARTICLES)
    return figure


def ess(results: Results) -> Figure | None:
    """Figure 8: effective share of the particles before resampling; bold: mean over runs and 5 s,
    thin: run 1, shade: the paper's 0.3 to 0.6."""
    one = results.get(DEFAULT, SHOWN)
    if one is None:
        return None
    share = one.record.series["ess_share"]
    width = max(1, min(round(5.0 / one.dt), share.shape[1]))
    smooth = uniform_filter1d(np.nanmean(share, 0), width, axis=0, mode="nearest")
    title = "Effective sample size over time"
    figure, panels = _over_time(one, title, "ESS ÷ particles", share[0], smooth)
    for axes in panels:
        axes.axhspan(*paper.ESS_BAND, color=MUTED, alpha=0.15, linewidth=0, zorder=0)
        axes.set_ylim(0, 1)
    return figure


def cdf(results: Results) -> Figure | None:
    """Figure 9: distribution of the RMSE over runs; left: each UAV (dashed: its mean), right:
    methods."""
    there = results.runs(FIGURE_9, list(_LINES))
    if not there:
        return None
    whole = next(iter(there.values())).evaluation
    title = f"Distribution of the RMSE · {whole.runs} runs"
    figure, (left, right) = _panels(2, 4.4, title, sharey=True)
    if SHOWN in there:
        tracks = metrics.rmse_per_track(there[SHOWN].error, there[SHOWN].scored)
        for i, colour in enumerate(_uavs(there[SHOWN])):
            _steps(left, tracks[:, i], color=colour, linewidth=1.4, label=_name(i))
            left.axvline(tracks[:, i].mean(), color=colour, linestyle="--", linewidth=0.8)
        left.legend(loc="lower right")
    for agent, one in there.items():
        _steps(right, rmse(one), label=paper.METHODS[agent], **_LINES[agent])
    if whole.bound is not None:
        right.axvline(whole.bound.rmse, label="posterior bound", **BOUND)
    right.legend(loc="lower right")
    left.set(ylabel="share of runs below (%)", ylim=(0, 101))
    for axes, part in ((left, "PF-NN, each UAV"), (right, "methods, whole team")):
        axes.set(xlabel="RMSE of a run (m)")
        axes.set_title(part, fontsize=9.5)
    return figure


# ------------------------------------------------------------------ parts


def _panels(
    count: int, height: float, title: str, sharey: bool = False
) -> tuple[Figure, list[Axes]]:
    """A row of so many."""
    size = (7.5 if count == 1 else 9.5, height)
    figure, (row,) = drawing.panels(1, count, size, title, sharey=sharey)
    return figure, row


def _over_time(
    one: Runs, title: str, label: str, thin: Floats, bold: Floats
) -> tuple[Figure, list[Axes]]:
    """A panel for each UAV with two lines [K, N]."""
    colours = _uavs(one)
    rows = -(-len(colours) // _ACROSS)
    size, headline = (9.5, 1.0 + 1.9 * rows), f"{title} · PF-NN, {len(one.error)} runs"
    figure, grid = drawing.panels(rows, _ACROSS, size, headline, sharex=True, sharey=True)
    every, time = [axes for row in grid for axes in row], _time(one)
    for axes in every[len(colours) :]:
        axes.set_visible(False)
    for i, (axes, colour) in enumerate(zip(every, colours, strict=False)):
        axes.plot(time, thin[:, i], color=colour, linewidth=0.5, alpha=0.5)
        axes.plot(time, bold[:, i], color=colour, linewidth=1.5)
        axes.set_title(_name(i), fontsize=9.5)
        axes.set_xlim(0.0, max(float(time[-1]), 1e-3))
    for axes in grid[-1]:
        axes.set_xlabel("time (s)")
    for row in grid:
        row[0].set_ylabel(label)
    return figure, every[: len(colours)]


def _steps(axes: Axes, values: Floats, **style: Any) -> None:
    kept = np.sort(values[np.isfinite(values)])
    share = 100 * np.arange(1, len(kept) + 1) / len(kept)
    axes.step(np.concatenate((kept[:1], kept)), np.concatenate(([0], share)), where="post", **style)


def _uavs(one: Runs) -> list[tuple[float, float, float]]:
    return [(r, g, b) for r, g, b in uav_colours(one.error.shape[2]).tolist()]


def _name(i: int) -> str:
    return f"UAV-{i + 1}"


def _time(one: Runs) -> Floats:
    return np.arange(one.steps) * one.dt


FIGURES: dict[str, drawing.Drawing] = {
    "figure_2_ablation.png": ablation,
    "figure_3_trajectories.png": trajectories,
    "figure_4_errors.png": errors,
    "figure_5_rmse.png": bars,
    "figure_6_boxes.png": boxes,
    "figure_7_particles.png": counts,
    "figure_8_ess.png": ess,
    "figure_9_cdf.png": cdf,
}
