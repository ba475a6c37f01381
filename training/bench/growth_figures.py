"""Figures of ``coloc bench --growth`` and ``--device``."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from coloc_env.render.style import UAV_COLOURS, uav_colours
from training.evaluation.figures import STYLE

_AXES = {
    "n_uavs": "UAVs, one world",
    "worlds": "worlds at once",
    "particles": "particles a UAV",
    "landmarks": "landmarks",
}


def growth_figure(results: dict[str, Any]) -> Figure:
    """Above, ms of a step of worlds and agent; below, MB allocated at its height."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(14, 7), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(2, len(_AXES), sharex="col")
        names = list(dict.fromkeys(one["name"] for one in results["sweeps"]))
        colours = dict(zip(names, uav_colours(len(names)), strict=True))
        markers = {name: "os^"[i // len(UAV_COLOURS)] for i, name in enumerate(names)}
        for column, (key, label) in enumerate(_AXES.items()):
            for one in (each for each in results["sweeps"] if each["key"] == key):
                look = {
                    "color": colours[one["name"]],
                    "marker": markers[one["name"]],
                    "markersize": 3,
                    "linestyle": "--" if one["scenario"] != "indoor-v0" else "-",
                    "label": f"{one['name']}, {one['scenario']}",
                }
                axes[0, column].loglog(one["size"], one["ms"], **look)
                axes[1, column].loglog(one["size"], [b / 1e6 for b in one["bytes"]], **look)
            axes[1, column].set(xlabel=label)
            if axes[0, column].lines:
                axes[0, column].legend(fontsize=6)
        axes[0, 0].set(ylabel="ms a step")
        axes[1, 0].set(ylabel="MB at the height of a step")
        return figure


def device_figure(results: dict[str, Any]) -> Figure:
    """Agent-steps per second against worlds at once, by agent; a line a device."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8, 4), layout="constrained")
        FigureCanvasAgg(figure)
        (axes,) = [figure.add_subplot()]
        agents = list(next(iter(results["devices"].values())))
        for agent, colour in zip(agents, uav_colours(len(agents)), strict=True):
            for device, style in zip(results["devices"], ("-", "--"), strict=False):
                one = results["devices"][device][agent]
                name = f"{agent}, {device}"
                speeds = one["agent_steps_per_s"]
                axes.loglog(one["size"], speeds, style, color=colour, marker="o", label=name)
        axes.set(xlabel="worlds at once, 6 UAVs each", ylabel="agent-steps per second")
        axes.legend(fontsize=7)
        return figure
