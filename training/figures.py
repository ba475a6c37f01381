"""Figures of an evaluation as PNG: one colour per agent throughout, the bound dashed and black."""

from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from coloc_env.render.style import GRID, INK, MUTED, uav_colours
from training import metrics
from training.metrics import Floats
from training.results import FIGURES, Results

STYLE = {
    "axes.axisbelow": True,
    "axes.edgecolor": MUTED,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 11.0,
    "font.family": "DejaVu Sans",
    "font.size": 10.0,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "legend.fontsize": 9.0,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "text.color": INK,
    "xtick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.color": MUTED,
    "ytick.labelcolor": INK,
}
_SHOWN = 6  # UAVs whose trajectories are drawn


def draw(results: Results, folder: Path) -> None:
    """Write all figures into a folder."""
    drawings: Sequence[Callable[[Results], Figure]] = (
        error_over_time,
        error_distribution,
        error_boxes,
        consistency,
        trajectories,
    )
    for name, drawing in zip(FIGURES, drawings, strict=True):
        with mpl.rc_context(STYLE):
            figure = drawing(results)
            figure.savefig(folder / name, dpi=150)


def error_over_time(results: Results) -> Figure:
    """RMS error over runs and UAVs at each step, with the middle half of the errors."""
    figure, axes = _figure(results, "Position error over time")
    time = _time(results)
    for name, colour in _colours(results).items():
        error = results.agents[name].error
        axes.plot(time, metrics.rmse_per_step(error, results.scored), color=colour)
        quarter = _quantiles_per_step(error, results.scored, (0.25, 0.75))
        axes.fill_between(time, *quarter, color=colour, alpha=0.15, linewidth=0)
    if results.bound is not None:
        bound = results.bound.mse.numpy() ** 0.5
        axes.plot(time, metrics.rmse_per_step(bound, results.bound.scored.numpy()), **_BOUND)
    axes.set(xlabel="time (s)", ylabel="position error (m)", yscale="log")
    axes.set_xlim(time[0], max(time[-1], results.dt))
    _legend(axes, results, note="line: RMS over runs and UAVs; shade: middle half")
    return figure


def error_distribution(results: Results) -> Figure:
    """Share of all errors below a value."""
    figure, axes = _figure(results, "Distribution of position errors")
    share = np.concatenate(([0, 1e-3], np.linspace(0.005, 0.995, 397), [0.999, 1]))
    for name, colour in _colours(results).items():
        errors = results.agents[name].error[results.scored]
        if errors.size:
            axes.plot(np.quantile(errors, share), 100 * share, color=colour)
    _mark_bound(axes, results)
    axes.set(xlabel="position error (m)", ylabel="share of errors below (%)", xscale="log")
    axes.set_ylim(0, 100)
    _legend(axes, results, note="all steps, UAVs and runs")
    return figure


def error_boxes(results: Results) -> Figure:
    """RMSE of each UAV in each run: quartiles, 5 % to 95 % whiskers, every one as a dot."""
    count = len(results.agents)
    figure, axes = _figure(results, "RMSE of each UAV in each run", 1.6 + 0.45 * count)
    jitter = np.random.default_rng(0)
    for row, (name, colour) in enumerate(_colours(results).items()):
        tracks = metrics.rmse_per_track(results.agents[name].error, results.scored)
        tracks = tracks[np.isfinite(tracks)]
        axes.boxplot(
            [tracks],
            positions=[row],
            orientation="horizontal",
            widths=0.5,
            whis=(5, 95),
            showfliers=False,
            patch_artist=True,
            boxprops={"facecolor": (*colour, 0.25), "edgecolor": colour},
            medianprops={"color": colour, "linewidth": 2},
            whiskerprops={"color": colour},
            capprops={"color": colour},
        )
        height = row + jitter.uniform(-0.2, 0.2, tracks.size)
        axes.plot(tracks, height, ".", color=colour, markersize=3, alpha=0.5, markeredgewidth=0)
    _mark_bound(axes, results)
    axes.set(xlabel="RMSE (m)", xscale="log")
    axes.set_yticks(range(count), list(results.agents))
    axes.set_ylim(count - 0.5, -0.5)
    axes.grid(False, axis="y")
    return figure


def consistency(results: Results) -> Figure:
    """Mean NEES at each step with the band in which a consistent estimator's lies."""
    figure, axes = _figure(results, "Consistency: NEES over time")
    time, dim = _time(results), results.scenario.arena.dim
    for name, colour in _colours(results).items():
        axes.plot(time, _mean_per_step(results.agents[name].nees, results), color=colour)
    counts = results.scored.sum((0, 2))
    bands = {n: metrics.nees_band(dim, n) if n else (np.nan, np.nan) for n in set(counts.tolist())}
    low, high = np.array([bands[n] for n in counts.tolist()]).T
    axes.fill_between(time, low, high, color=MUTED, alpha=0.3, linewidth=0)
    axes.axhline(dim, color=INK, linewidth=0.8)
    axes.set(xlabel="time (s)", ylabel="NEES of the position", yscale="log")
    axes.set_xlim(time[0], max(time[-1], results.dt))
    note = f"mean over runs and UAVs; {dim} is consistent, shade: 95 %; above: overconfident"
    _legend(axes, results, bound=False, note=note)
    return figure


def trajectories(results: Results) -> Figure:
    """Truth and estimates of the first run's first UAVs: plan, and height over time."""
    deep = results.scenario.arena.dim == 3
    uavs = min(_SHOWN, results.scenario.arena.n_uavs)
    whole = "" if uavs == results.scenario.arena.n_uavs else f", uav_0 to uav_{uavs - 1}"
    figure = Figure(figsize=(10.5 if deep else 6.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    panels = np.atleast_1d(figure.subplots(1, 2 if deep else 1, width_ratios=[1.1, 1][: 1 + deep]))
    time, truth = _time(results), _shown(results, results.truth[0])
    tracks = {
        name: (truth + results.agents[name].offset[0], colour)
        for name, colour in _colours(results).items()
    }
    _track(panels[0], truth[..., 0], truth[..., 1], uavs, color=_TRUTH, linewidth=4)
    for estimate, colour in tracks.values():
        _track(panels[0], estimate[..., 0], estimate[..., 1], uavs, color=colour, linewidth=0.9)
    panels[0].set(xlabel="x (m)", ylabel="y (m)", title=f"Seed {results.seed}{whole}: plan")
    panels[0].set_aspect("equal", adjustable="box")
    _limit(panels[0].set_xlim, truth[..., 0])
    _limit(panels[0].set_ylim, truth[..., 1])
    if deep:
        over = np.broadcast_to(time[:, None], truth.shape[:2])
        _track(panels[1], over, truth[..., 2], uavs, color=_TRUTH, linewidth=4)
        for estimate, colour in tracks.values():
            _track(panels[1], over, estimate[..., 2], uavs, color=colour, linewidth=0.9)
        panels[1].set(xlabel="time (s)", ylabel="z (m)", title="Height")
        _limit(panels[1].set_ylim, truth[..., 2])
        panels[1].set_xlim(time[0], max(time[-1], results.dt))
    lines = [Line2D([], [], color=_TRUTH, linewidth=4, label="truth")]
    lines += [Line2D([], [], color=c, label=name) for name, (_, c) in tracks.items()]
    figure.legend(handles=lines, loc="outside lower center", ncols=min(4, len(lines)))
    return figure


# ------------------------------------------------------------------ parts

_BOUND = {"color": "black", "linestyle": (0, (5, 3)), "linewidth": 1.3}
_TRUTH = "#c4cad6"


def _figure(results: Results, title: str, height: float = 4.4) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(7.5, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.set_title(f"{title} · {results.scenario.name}, {results.runs} runs", fontweight="bold")
    return figure, axes


def _colours(results: Results) -> dict[str, tuple[float, ...]]:
    """One colour per agent, the same in all figures."""
    names = list(results.agents)
    return dict(zip(names, map(tuple, uav_colours(len(names))), strict=True))


def _time(results: Results) -> Floats:
    return np.arange(results.scenario.horizon) * results.dt


def _legend(axes: Axes, results: Results, note: str, bound: bool = True) -> None:
    """Agents and the bound below the axes, and what is shown."""
    lines = [Line2D([], [], color=c, label=name) for name, c in _colours(results).items()]
    if bound and results.bound is not None:
        lines.append(Line2D([], [], label="bound", **_BOUND))
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    figure.legend(handles=lines, loc="outside lower center", ncols=min(4, len(lines)))
    axes.text(1, 1, note, transform=axes.transAxes, ha="right", va="bottom", fontsize=8, color=MUTED)


def _mark_bound(axes: Axes, results: Results) -> None:
    if results.bound is not None:
        axes.axvline(results.bound.rmse, **_BOUND)


def _quantiles_per_step(error: Floats, scored: np.ndarray, shares: tuple[float, ...]) -> Floats:
    """[shares, K], NaN where nothing is scored."""
    kept = np.where(scored, error, np.nan).swapaxes(0, 1).reshape(error.shape[1], -1)
    out = np.full((len(shares), len(kept)), np.nan)
    some = ~np.isnan(kept).all(1)
    out[:, some] = np.nanquantile(kept[some], shares, axis=1)
    return out


def _mean_per_step(values: Floats, results: Results) -> Floats:
    """[K], of what is scored and not NaN."""
    counts = results.scored & ~np.isnan(values)
    total = np.where(counts, values, 0.0).sum((0, 2), dtype=np.float64)
    number = counts.sum((0, 2))
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def _shown(results: Results, position: Floats) -> Floats:
    """Positions with NaN, a gap in a line, where they are not scored."""
    return np.where(results.scored[0][..., None], position, np.nan)


def _track(axes: Axes, x: Floats, y: Floats, uavs: int, **style: object) -> None:
    for i in range(uavs):
        axes.plot(x[:, i], y[:, i], solid_capstyle="round", **style)


def _limit(set_limits: Callable[[float, float], object], truth: Floats) -> None:
    """Limits about the truth, wide enough for fair estimates, not for lost ones."""
    if np.isfinite(truth).any():
        low, high = float(np.nanmin(truth)), float(np.nanmax(truth))
        margin = max(0.25 * (high - low), 1e-3)
        set_limits(low - margin, high + margin)
