"""Figures of ``coloc bench`` as PNG."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from coloc_env.render.style import MUTED, uav_colours
from training.evaluation.figures import STYLE

FIGURES = ("environments.png", "scaling.png", "agents.png", "parts.png")
_PEERS = ("mpe2", "VMAS")


def draw(results: dict[str, Any], folder: Path) -> None:
    """Write the figures that the results have figures for."""
    drawings: tuple[Callable[[dict[str, Any]], Figure | None], ...] = (
        environments,
        scaling,
        agents,
        parts,
    )
    for name, drawing in zip(FIGURES, drawings, strict=True):
        with mpl.rc_context(STYLE):
            figure = drawing(results)
            if figure is not None:
                figure.savefig(folder / name, dpi=150)


def environments(results: dict[str, Any]) -> Figure:
    """Agent-steps per second of every environment; peers in grey."""
    speeds = {
        name: figures["agent_steps_per_s"]
        for name, figures in results["environments"].items()
        if not name.startswith(("team", "landmarks"))
    }
    figure, (axes,) = _figure(1, 0.8 + 0.28 * len(speeds), "Speed on one CPU thread")
    names = list(reversed(speeds))
    colour = uav_colours(1)[0]
    bars = axes.barh(
        names,
        [speeds[name] for name in names],
        color=[MUTED if name.startswith(_PEERS) else colour for name in names],
    )
    axes.bar_label(bars, [f"{speeds[name]:,.0f}" for name in names], padding=3, fontsize=8)
    axes.set(xscale="log", xlabel="agent-steps per second")
    axes.margins(x=0.2, y=0.02)
    axes.grid(axis="y", visible=False)
    return figure


def scaling(results: dict[str, Any]) -> Figure:
    """One world's step over the team's size, and a batch's over the number of landmarks."""
    figure, (left, right) = _figure(2, 3.6, "Time of a step")
    for axes, group, label in (
        (left, "team N=", "UAVs, one world"),
        (right, "landmarks L=", "landmarks, 32 worlds of 6 UAVs"),
    ):
        found = results["environments"].items()
        points = {int(k.removeprefix(group)): f["ms"] for k, f in found if k.startswith(group)}
        axes.plot(list(points), list(points.values()), "o-", color=uav_colours(1)[0])
        axes.set(xlabel=label, ylabel="ms a step", ylim=(0, None))
    return figure


def agents(results: dict[str, Any]) -> Figure | None:
    """A team's step of every localizer, and of a particle filter by particles and by UAVs."""
    if not results.get("agents"):
        return None
    figure, (first, second, third) = _figure(3, 3.6, "Time of a team's step, one world")
    colour = uav_colours(1)[0]
    timed = {name: ms for name, ms in results["agents"].items() if ms is not None}
    names = list(reversed(timed))
    bars = first.barh(names, [timed[name] for name in names], color=colour)
    first.bar_label(bars, [f"{timed[name]:.3g}" for name in names], padding=3, fontsize=8)
    first.set(xlabel="ms a step")
    first.margins(x=0.2)
    first.grid(axis="y", visible=False)
    for axes, key, label in (
        (second, "particles", "particles per UAV, 6 UAVs"),
        (third, "teams", "UAVs, 800 particles each"),
    ):
        points = {int(k): ms for k, ms in results[key].items() if ms is not None}
        axes.plot(list(points), list(points.values()), "o-", color=colour)
        axes.set(xlabel=label, ylabel="ms a step", ylim=(0, None))
    return figure


def parts(results: dict[str, Any]) -> Figure | None:
    """Where the time of a team's step goes."""
    found: dict[str, dict[str, float]] = results.get("parts", {})
    if not found:
        return None
    figure, (axes,) = _figure(1, 1.2 + 0.5 * len(found), "Where a team's step goes, one world")
    every = list(dict.fromkeys(part for one in found.values() for part in one))
    names = list(reversed(found))
    left = [0.0] * len(names)
    colours = mpl.colormaps["tab20"](
        range(20)
    )  # more parts than a palette safe for all has colours
    for part, colour in zip(every, colours, strict=False):
        widths = [found[name].get(part, 0.0) for name in names]
        bars = axes.barh(names, widths, left=left, color=colour, label=part)
        shares = [w / sum(found[n].values()) for n, w in zip(names, widths, strict=True)]
        texts = [f"{share:.0%}" if share >= 0.05 else "" for share in shares]
        axes.bar_label(bars, texts, label_type="center", fontsize=7)
        left = [a + b for a, b in zip(left, widths, strict=True)]
    axes.set(xlabel="ms a step")
    axes.grid(axis="y", visible=False)
    axes.legend(ncols=4, fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.3), frameon=False)
    return figure


def _figure(panels: int, height: float, title: str) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(4.5 * panels if panels > 1 else 8.0, height), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
    return figure, [figure.add_subplot(1, panels, i + 1) for i in range(panels)]
