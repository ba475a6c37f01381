"""Figures of an evaluation as PNG: one colour per agent throughout, the bound dashed and black."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import Bbox

from coloc_env.render.style import GRID, INK, MUTED, uav_colours
from training.evaluation import metrics
from training.evaluation.metrics import Flags, Floats
from training.evaluation.results import Evaluation

STYLE: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.edgecolor": MUTED,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 11.0,
    "axes.titleweight": "bold",
    "font.family": "DejaVu Sans",
    "font.size": 10.0,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "legend.fontsize": 9.0,
    "legend.frameon": False,
    "text.color": INK,
    "xtick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.color": MUTED,
    "ytick.labelcolor": INK,
}
BOUND: dict[str, Any] = {"color": "black", "linestyle": (0, (5, 3)), "linewidth": 1.3, "zorder": 5}
_TRUTH: dict[str, Any] = {"color": "#c4cad6", "linewidth": 5}
_SHOWN = 100.0  # s of a run that a picture of trajectories shows at most
_IN_PLAN, _IN_HEIGHT = 6, 3  # UAVs whose trajectories are drawn


def draw(results: Evaluation, folder: Path, names: Sequence[str]) -> None:
    """Write all figures into a folder, by ``names`` whose endings say in which format."""
    drawings: Sequence[Callable[[Evaluation], Figure]] = (
        error_over_time,
        error_distribution,
        error_boxes,
        consistency,
        trajectories,
    )
    for name, drawing in zip(names, drawings, strict=True):
        with mpl.rc_context(STYLE):
            figure = drawing(results)
            # A legend may be wider than the figure: grow the page, never crop it.
            page = Bbox.union([figure.bbox_inches, figure.get_tightbbox()])
            figure.savefig(folder / name, dpi=150, bbox_inches=page)


def error_over_time(results: Evaluation) -> Figure:
    """RMS error over runs and UAVs at each step, with the middle half of the errors."""
    note = "line: root mean square over runs and UAVs; shade: middle half of the errors"
    figure, axes = _figure(results, "Position error over time", note)
    time = _time(results)
    for name, style in _line_styles(results).items():
        error = results.agents[name].error
        axes.plot(time, metrics.rmse_per_step(error, results.worlds.scored), **style)
        half = _quantiles_per_step(error, results.worlds.scored, (0.25, 0.75))
        axes.fill_between(time, *half, color=style["color"], alpha=0.12, linewidth=0)
    if results.bound is not None:
        bound = results.bound.mse.numpy() ** 0.5
        axes.plot(time, metrics.rmse_per_step(bound, results.bound.scored.numpy()), **BOUND)
    axes.set(xlabel="time (s)", ylabel="position error (m)", xlim=_span(time, results.dt))
    log_axis(axes.yaxis, axes.set_yscale)
    _cut(axes.get_ylim, axes.set_ylim, _farthest(results))
    _legend(figure, results)
    return figure


def error_distribution(results: Evaluation) -> Figure:
    """Share of all errors below a value."""
    figure, axes = _figure(results, "Distribution of position errors", "all steps, UAVs and runs")
    share = np.concatenate(([1e-3], np.linspace(0.005, 0.995, 397), [0.999, 1]))
    for name, style in _line_styles(results).items():
        errors = results.agents[name].error[results.worlds.scored]
        if errors.size:
            axes.plot(np.quantile(errors, share), 100 * share, **style)
    _mark_bound(axes, results)
    axes.set(xlabel="position error (m)", ylabel="share of errors below (%)", ylim=(0, 100))
    log_axis(axes.xaxis, axes.set_xscale)
    _cut(axes.get_xlim, axes.set_xlim, _farthest(results))
    _legend(figure, results)
    return figure


def error_boxes(results: Evaluation) -> Figure:
    """RMSE of each UAV in each run: quartiles, 5 % to 95 % whiskers, every one as a dot."""
    count, limit = len(results.agents), _farthest(results)
    note = "box: quartiles; whiskers: 5 % to 95 %; dots: every UAV and run"
    note += "" if results.bound is None else "; dashed: bound"
    figure, axes = _figure(results, "RMSE of each UAV in each run", note, 1.7 + 0.5 * count)
    jitter = np.random.default_rng(0)
    for row, (name, style) in enumerate(_line_styles(results).items()):
        tracks = metrics.rmse_per_track(results.agents[name].error, results.worlds.scored)
        tracks, line = tracks[np.isfinite(tracks)], {"color": style["color"]}
        if not tracks.size:
            continue
        axes.boxplot(
            [np.minimum(tracks, limit)],
            positions=[row],
            orientation="horizontal",
            widths=0.55,
            whis=(5, 95),
            showfliers=False,
            patch_artist=True,
            boxprops={"facecolor": (*style["color"], 0.2), "edgecolor": style["color"]},
            medianprops=line | {"linewidth": 2},
            whiskerprops=line,
            capprops=line,
        )
        height = row + jitter.uniform(-0.2, 0.2, tracks.size)
        axes.plot(tracks, height, ".", **line, markersize=4, alpha=0.4, markeredgewidth=0)
        middle = float(np.median(tracks))
        if middle > limit:
            label = f"median {middle:.3g} m →  "
            axes.text(limit, row - 0.32, label, ha="right", fontsize=8, **line)
    _mark_bound(axes, results)
    axes.set(xlabel="RMSE (m)", ylim=(count - 0.5, -0.5))
    log_axis(axes.xaxis, axes.set_xscale)
    _cut(axes.get_xlim, axes.set_xlim, limit)
    axes.set_yticks(range(count), list(results.agents))
    axes.grid(False, axis="y")
    return figure


def consistency(results: Evaluation) -> Figure:
    """Mean NEES at each step with the band in which a consistent estimator's lies."""
    dim = results.scenario.arena.dim
    note = f"mean over runs and UAVs; {dim} is consistent (shade: 95 %), more is overconfident"
    figure, axes = _figure(results, "Consistency: NEES over time", note)
    time = _time(results)
    for name, style in _line_styles(results).items():
        style["linewidth"] *= 0.6
        nees = results.agents[name].nees
        axes.plot(time, metrics.mean_per_step(nees, results.worlds.scored), **style)
    low, high = metrics.nees_bands(dim, results.worlds.scored)
    axes.fill_between(time, low, high, color=MUTED, alpha=0.25, linewidth=0, zorder=0)
    axes.axhline(dim, color=INK, linewidth=0.8)
    axes.set(xlabel="time (s)", ylabel="NEES of the position", xlim=_span(time, results.dt))
    log_axis(axes.yaxis, axes.set_yscale)
    _cut(axes.get_ylim, axes.set_ylim, 1000 * dim)
    _legend(figure, results, bound=False)
    return figure


def trajectories(results: Evaluation) -> Figure:
    """Truth and estimates in the last 100 s of the first run: plan, and height over time."""
    deep = results.scenario.arena.dim == 3
    last = slice(-round(_SHOWN / results.dt), None)
    figure = Figure(figsize=(10.5 if deep else 6.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 2 if deep else 1, squeeze=False)[0]
    shown = results.worlds.scored[0, last][..., None]
    truth = np.where(shown, results.worlds.truth[0, last] + results.origin, np.nan)
    tracks = [(truth, _TRUTH)]
    for name, style in _line_styles(results).items():
        tracks.append((truth + results.agents[name].offset[0, last], style | {"linewidth": 1.0}))
    title = f"Seed {results.seed}"
    time = np.broadcast_to(_time(results)[last, None], truth.shape[:2])
    plan = slice(0, _IN_PLAN)
    for position, style in tracks:
        panels[0].plot(position[:, plan, 0], position[:, plan, 1], **style)
    panels[0].set(xlabel="x (m)", ylabel="y (m)", title=f"{title}: plan{_which(results, _IN_PLAN)}")
    panels[0].set_aspect("equal", adjustable="box")
    _limit(panels[0].set_xlim, truth[:, plan, 0])
    _limit(panels[0].set_ylim, truth[:, plan, 1])
    if deep:
        few = slice(0, _IN_HEIGHT)
        for position, style in tracks:
            panels[1].plot(time[:, few], position[:, few, 2], **style)
        panels[1].set(xlabel="time (s)", ylabel="z (m)", xlim=_span(time[:, 0], results.dt))
        panels[1].set_title(f"{title}: height{_which(results, _IN_HEIGHT)}")
        _limit(panels[1].set_ylim, truth[:, few, 2])
    handles = [Line2D([], [], label="truth", **_TRUTH)]
    _legend(figure, results, handles, bound=False)
    return figure


# ------------------------------------------------------------------ parts


def _figure(results: Evaluation, title: str, note: str, height: float = 4.5) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(7.5, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.set_title(f"{title} · {results.scenario.name}, {results.runs} runs", pad=20)
    axes.annotate(note, (0, 1), (0, 6), "axes fraction", "offset points", fontsize=8.5, color=MUTED)
    return figure, axes


def _line_styles(results: Evaluation) -> dict[str, dict[str, Any]]:
    """One colour per agent, the same in all figures; later lines are thinner, so that lines that
    coincide can all be seen."""
    names = list(results.agents)
    widths = np.linspace(2.4, 1.2, len(names)) if len(names) > 1 else [1.8]
    colours = map(tuple, uav_colours(len(names)))
    return {
        name: {"color": colour, "linewidth": float(width)}
        for name, colour, width in zip(names, colours, widths, strict=True)
    }


def _legend(
    figure: Figure, results: Evaluation, handles: Sequence[Line2D] = (), bound: bool = True
) -> None:
    """Agents, and the bound, below the axes."""
    styles = _line_styles(results).items()
    lines = [*handles, *(Line2D([], [], label=x, color=y["color"], lw=2) for x, y in styles)]
    if bound and results.bound is not None:
        lines.append(Line2D([], [], label="bound", **BOUND))
    letters = sum(len(str(line.get_label())) + 6 for line in lines)
    columns = len(lines) if letters < 14 * figure.get_figwidth() else 3
    figure.legend(handles=lines, loc="outside lower center", ncols=columns)


def _mark_bound(axes: Axes, results: Evaluation) -> None:
    if results.bound is not None:
        axes.axvline(results.bound.rmse, **BOUND)


def log_axis(axis: Any, set_scale: Callable[[str], None]) -> None:
    """A logarithmic axis with plain numbers, if there is anything on it."""
    if not np.isfinite(axis.get_minpos()):
        return
    set_scale("log")
    low, high = sorted(axis.get_view_interval())
    steps = (1, 2, 5) if high < 50 * low else (1, 3) if high < 3000 * low else (1,)
    axis.set_major_locator(LogLocator(subs=steps, numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _cut(
    get_limits: Callable[[], tuple[float, float]],
    set_limits: Callable[[float, float], object],
    highest: float,
) -> None:
    """Leave out what lies beyond ``highest``, unless that is everything."""
    low, high = get_limits()
    if low < highest < high:
        set_limits(low, highest)


def _farthest(results: Evaluation) -> float:
    """Errors beyond this (m) leave the figure: the arena's diagonal, or more if all are so bad."""
    arena = results.scenario.arena
    diagonal = float(np.linalg.norm(np.subtract(arena.high, arena.low)))
    errors = [metrics.rmse(one.error, results.worlds.scored) for one in results.agents.values()]
    return max(diagonal, 2 * min(errors)) if np.isfinite(errors).all() else diagonal


def _time(results: Evaluation) -> Floats:
    return np.arange(results.scenario.horizon) * results.dt


def _span(time: Floats, dt: float) -> tuple[float, float]:
    return float(time[0]), max(float(time[-1]), dt)


def _which(results: Evaluation, shown: int) -> str:
    return f", {shown} of {n} UAVs" if (n := results.scenario.arena.n_uavs) > shown else ""


def _quantiles_per_step(error: Floats, scored: Flags, shares: tuple[float, ...]) -> Floats:
    """[shares, K], NaN where nothing is scored."""
    kept = np.where(scored, error, np.nan).swapaxes(0, 1).reshape(error.shape[1], -1)
    out = np.full((len(shares), len(kept)), np.nan)
    some = ~np.isnan(kept).all(1)
    out[:, some] = np.nanquantile(kept[some], shares, axis=1)
    return out


def _limit(set_limits: Callable[[float, float], object], truth: Floats) -> None:
    """Limits about the truth, wide enough for fair estimates, not for lost ones."""
    if np.isfinite(truth).any():
        low, high = float(np.nanmin(truth)), float(np.nanmax(truth))
        margin = max(0.25 * (high - low), 1e-3)
        set_limits(low - margin, high + margin)
