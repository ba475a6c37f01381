"""The study of robustness at a glance: a heat map, and paired differences with intervals."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from coloc_env.render.style import FLOOR, INK, MUTED, uav_colours
from training.evaluation.metrics import mean
from training.evaluation.results import short
from training.reproduce.drawing import save
from training.reproduce.pfnn.robustness import Cells, compare
from training.reproduce.study import Variant

FILES = ("robustness.png", "robustness_paired.png")
REFERENCE = "ekf:robust=huber"
_WORST = 30.0  # × the bound: what lies beyond has the same colour
_SHOWN = ("apf", "pf_trust", "ekf_trust", "ekf:robust=gate", "ekf_joint")
_SHADES = LinearSegmentedColormap.from_list("shades", (FLOOR, "#9ecae9", "#0072B2", "#0b1f3a"))
_WIDEST = 100.0  # %: differences beyond are drawn at the edge


def draw(
    found: Cells,
    bounds: Mapping[str, float | None],
    variants: Sequence[Variant],
    agents: Sequence[str],
    folder: Path,
) -> dict[str, str]:
    """Write the figures; their captions by file name."""
    shown = [variant for variant in variants if variant.key in found]
    captions = {}
    figures: dict[str, Callable[[], Figure]] = {}
    figures[FILES[0]] = partial(heat_map, found, bounds, shown, agents)
    captions[FILES[0]] = (
        "RMSE over whole runs as a multiple of the posterior bound (of the best agent's where there"
        " is no bound: ‡). †: UAVs lost, of all runs'."
    )
    if any(REFERENCE in there and len(there) > 1 for there in found.values()):
        figures[FILES[1]] = partial(forest, found, shown, agents)
        captions[FILES[1]] = (
            f"RMSE against `{REFERENCE}` on the same worlds, with 95 % intervals of the paired "
            f"differences; left is better; beyond ±{_WIDEST:g} % an arrow."
        )
    for name, drawn in figures.items():
        save(drawn, folder / name)
    return captions


def heat_map(
    found: Cells,
    bounds: Mapping[str, float | None],
    variants: Sequence[Variant],
    agents: Sequence[str],
) -> Figure:
    """Variants down, agents across: RMSE by the bound."""
    ratio = np.full((len(variants), len(agents)), np.nan)
    labels = []
    for i, variant in enumerate(variants):
        there, bound = found[variant.key], bounds[variant.key]
        errors = {a: there[a].figures["rmse"] for a in agents if a in there}
        known = [value for value in errors.values() if value is not None]
        unit = bound or (min(known) if known else np.nan)
        labels.append(variant.title if bound else f"{variant.title} ‡")
        for j, agent in enumerate(agents):
            if errors.get(agent) is not None:
                ratio[i, j] = errors[agent] / unit
    size = (2.6 + 0.78 * len(agents), 1.6 + 0.3 * len(variants))
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    image = axes.imshow(ratio, aspect="auto", cmap=_SHADES, norm=LogNorm(1.0, _WORST))
    for (i, j), value in np.ndenumerate(ratio):
        if np.isfinite(value):
            cell = found[variants[i].key][agents[j]]
            lost = cell.figures["lost_uavs"]
            text = (f"{value:.2f}" if value < 10 else short(value)) + (f" †{lost}" * (lost > 0))
            dark = value > 0.8 * np.sqrt(_WORST)
            axes.text(j, i, text, ha="center", va="center", fontsize=7.5,
                      color="white" if dark else INK)  # fmt: skip
        else:
            axes.text(j, i, "–", ha="center", va="center", fontsize=7.5, color=MUTED)
    axes.set_yticks(range(len(labels)), labels, fontsize=8.5)
    axes.set_xticks(range(len(agents)), agents, fontsize=8.5, rotation=35, ha="left")
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_xticks(np.arange(0.5, len(agents) - 1), minor=True)
    axes.set_yticks(np.arange(0.5, len(labels) - 1), minor=True)
    axes.grid(True, which="minor", color="white", linewidth=1.5)
    axes.tick_params(which="minor", length=0)
    bar = figure.colorbar(image, ax=axes, shrink=0.5, aspect=30, pad=0.02, extend="max")
    ticks = [1, 2, 5, 10, 20]
    bar.set_ticks(ticks, labels=[f"{tick} ×" for tick in ticks])
    bar.ax.minorticks_off()
    bar.set_label("RMSE ÷ bound")
    figure.suptitle(
        "RMSE over whole runs ÷ posterior bound", x=0.01, ha="left", fontsize=11, weight="bold"
    )
    return figure


def forest(found: Cells, variants: Sequence[Variant], agents: Sequence[str]) -> Figure:
    """Paired differences to the reference in per cent of its mean RMSE, with intervals."""
    shown = [agent for agent in _SHOWN if agent in agents]
    shown += [a for a in agents if a.startswith("pf_trust:")]
    rows = [variant for variant in variants if REFERENCE in found[variant.key]]
    figure = Figure(figsize=(7.5, 1.6 + 0.36 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.axvline(0, color=INK, linewidth=1.0)
    for i in range(0, len(rows), 2):
        axes.axhspan(i - 0.5, i + 0.5, color=FLOOR, zorder=0)
    handles = []
    for j, (agent, rgb) in enumerate(zip(shown, uav_colours(len(shown)), strict=True)):
        colour = (float(rgb[0]), float(rgb[1]), float(rgb[2]))
        handles.append(Line2D([], [], color=colour, marker="o", lw=2, ms=4, label=agent))
        for i, variant in enumerate(rows):
            there = found[variant.key]
            apart = compare(there, agent, REFERENCE)
            if apart is None or not np.isfinite(apart.mean):
                continue
            scale = 100 / mean(there[REFERENCE].rmse)
            y = i + 0.7 * ((j + 0.5) / len(shown) - 0.5)
            ends = np.clip([scale * apart.low, scale * apart.high], -_WIDEST, _WIDEST)
            if np.isfinite(apart.low):
                axes.plot(ends, [y, y], color=colour, linewidth=1.6)
            middle = scale * apart.mean
            mark = "o" if abs(middle) <= _WIDEST else "<" if middle < 0 else ">"
            at = float(np.clip(middle, -_WIDEST, _WIDEST))
            axes.plot(at, y, mark, color=colour, markersize=4, clip_on=False)
    axes.set_yticks(range(len(rows)), [variant.title for variant in rows], fontsize=8.5)
    axes.set(xlim=(-_WIDEST, _WIDEST), ylim=(len(rows) - 0.5, -0.5))
    axes.set_xlabel(f"RMSE against {REFERENCE} (%)")
    axes.grid(False, axis="y")
    axes.set_title(f"Paired with {REFERENCE} on the same worlds")
    figure.legend(handles=handles, loc="outside lower center", ncols=min(4, len(handles)))
    return figure
