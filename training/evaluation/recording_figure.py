"""One picture of a recording: when every stream speaks, where everybody went, what ranges are off
by."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from coloc_env.datasets import Recording, Table, Track
from coloc_env.datasets.check import span_of
from coloc_env.datasets.residuals import has_truth, links_of, true_ranges
from coloc_env.render.style import MUTED, uav_colours
from training.evaluation.figures import STYLE

_MARKS = 2000  # samples of a stream that are drawn
_FARTHEST = 2.0  # m, of errors that are drawn


def draw_recording(recording: Recording, path: Path) -> None:
    """Write the picture as PNG."""
    with mpl.rc_context(STYLE):
        rows = len(recording.robots) * (len(recording.streams) + 1)
        figure = Figure(figsize=(10, 6 + 0.16 * rows), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(2, 2, height_ratios=(max(1.0, 0.16 * rows), 4.5))
        _timeline(figure.add_subplot(grid[0, :]), recording)
        _plan(figure.add_subplot(grid[1, 0]), recording)
        _errors(figure.add_subplot(grid[1, 1]), recording)
        figure.savefig(path, dpi=110)


def _timeline(axes: Axes, recording: Recording) -> None:
    """A line a stream, a mark a sample: gaps are what is not marked."""
    colours, zero = uav_colours(len(recording.robots)), span_of(recording)[0]
    names: list[str] = []
    for i, robot in enumerate(recording.robots):
        tables: dict[str, Table | Track] = {"truth": recording.truth[i]}
        tables |= {stream: team[i] for stream, team in recording.streams.items()}
        for stream, table in tables.items():
            if not len(table.time):
                continue
            step = max(1, len(table.time) // _MARKS)
            time = (table.time[::step] - zero) * 1e-9
            axes.plot(time, np.full(len(time), len(names)), "|", color=colours[i], markersize=5)
            names.append(f"{robot} {stream}")
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.invert_yaxis()
    axes.set_xlabel("time / s")
    axes.set_title(recording.name)


def _plan(axes: Axes, recording: Recording) -> None:
    colours = uav_colours(len(recording.robots))
    for colour, robot, track in zip(colours, recording.robots, recording.truth, strict=True):
        if len(track.time):
            x, y = track.position[:, :2].T
            axes.plot(x, y, color=colour, linewidth=0.8, label=robot)
    for places, mark, label in (
        (recording.anchors, "^", "anchors"),
        (recording.landmarks, "s", "landmarks"),
    ):
        if len(places):
            axes.plot(*places[:, :2].T, mark, color=MUTED, markersize=6, label=label)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x / m")
    axes.set_ylabel("y / m")
    axes.set_title("from above")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7)


def _errors(axes: Axes, recording: Recording) -> None:
    """Ranges less true distances, over time, a colour a robot."""
    zero, colours, drawn = span_of(recording)[0], uav_colours(len(recording.robots)), False
    for stream in ("anchor_ranges", "uav_ranges"):
        for link in links_of(recording, stream):
            if not has_truth(recording, link):
                continue
            distance, known = true_ranges(recording, link)
            error = (link.measured - distance)[known].clip(-_FARTHEST, _FARTHEST)
            time = (link.time[known] - zero) * 1e-9
            mark = "." if link.to_anchor else "x"
            axes.plot(time, error, mark, color=colours[link.robot], markersize=2, alpha=0.5)
            drawn = True
    axes.set_xlabel("time / s")
    axes.set_ylabel("range less truth / m")
    axes.set_title("ranges against truth (x: to robots)" if drawn else "no ranges with truth")
