"""The two charts: errors over time, and the estimates about the truth."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.ticker import FixedLocator, NullLocator

from coloc_env.motion import Arena
from coloc_env.render import style
from coloc_env.render.history import History, rms
from coloc_env.render.shapes import disc, ellipses, metres, nice, plan
from coloc_env.render.snapshot import Snapshot

_SMALLEST = 1e-4  # m; a smaller error is drawn as this


class ErrorStrip:
    """Each UAV's position error over time and the team's RMSE, on a logarithmic axis."""

    def __init__(self, axes: Axes, arena: Arena, horizon: int) -> None:
        self._axes, self._dt, self._end = axes, arena.dt, horizon * arena.dt
        few = arena.n_uavs <= 16
        self._errors = LineCollection(
            [],
            colors=[(*c, 0.75 if few else 0.22) for c in style.uav_colours(arena.n_uavs)],
            linewidths=1.0 if few else 0.7,
            zorder=2,
        )
        axes.add_collection(self._errors, autolim=False)
        (self._team,) = axes.plot([], [], color=style.INK, linewidth=1.9, zorder=3)
        self._name = axes.annotate(
            "team RMSE", (0, 0), (7, 0), textcoords="offset points", va="center", fontsize=9
        )
        axes.set_yscale("log")
        frame(axes)
        axes.grid(axis="y", color=style.GRID, linewidth=0.8)
        axes.set_axisbelow(True)

    def update(self, history: History) -> None:
        """Show the errors so far."""
        steps, errors = history.errors()
        errors = np.maximum(errors, _SMALLEST)
        time, team = steps * self._dt, rms(errors)
        self._errors.set_segments([np.stack((time, column), -1) for column in errors.T])
        self._team.set_data(time, team)
        self._scale(time, errors)
        scored = np.flatnonzero(np.isfinite(team))
        self._name.set_visible(len(scored) > 0)
        if len(scored):
            self._name.xy = time[scored[-1]], team[scored[-1]]

    def _scale(self, time: np.ndarray, errors: np.ndarray) -> None:
        """Limits at round numbers, so that they move rarely."""
        known = errors[np.isfinite(errors)]
        low, high = (known.min(), known.max()) if len(known) else (0.1, 1.0)
        low = max(0.5 * nice(0.9 * low), 1e-3 * nice(high))
        top = max(nice(high), 5 * low)
        end = min(nice(max(float(time[-1]) if len(time) else 0.0, 10 * self._dt)), self._end)
        self._axes.set_xlim(0, 1.09 * end)
        self._axes.set_ylim(low, top)
        powers = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(top)) + 1)
        marks = powers if top / low > 200 else np.outer(powers, (1, 2, 5)).ravel()
        marks = marks[(marks >= low * 0.999) & (marks <= top * 1.001)]
        axis = self._axes.yaxis
        axis.set_major_locator(FixedLocator(list(marks)))
        axis.set_major_formatter(lambda value, _: metres(value))
        axis.set_minor_locator(NullLocator())
        ticks = np.arange(0, end * 1.001, nice(end / 6))
        self._axes.set_xticks(ticks, [f"{t:g} s" for t in ticks])


class Target:
    """Every estimate about its UAV's true position (the centre), with its 2-σ ellipse, to scale.

    In three dimensions seen from above. Estimates beyond the outer ring lie on it.
    """

    def __init__(self, axes: Axes, arena: Arena) -> None:
        self._view = plan(arena.dim)
        colours, few = style.uav_colours(arena.n_uavs), arena.n_uavs <= 16
        axes.axis("off")
        axes.set_xlim(-1.04, 1.04)
        axes.set_ylim(-1.04, 1.04)
        options: dict[str, Any] = {"closed": True, "linewidths": 0.9}
        rings = [radius * disc(90) for radius in (1.0, 0.5)]
        axes.add_collection(
            PolyCollection(rings, facecolors=style.FLOOR, edgecolors=style.RULE, **options)
        )
        cross = [[(-1, 0), (1, 0)], [(0, -1), (0, 1)]]
        axes.add_collection(LineCollection(cross, colors=style.RULE, linewidths=0.9))
        tag: dict[str, Any] = {"color": style.MUTED, "fontsize": 9, "ha": "center", "va": "center"}
        back = {"facecolor": style.FLOOR, "edgecolor": "none", "pad": 1.5}
        at = 0.7071
        self._labels = [axes.text(r * at, -r * at, "", bbox=back, **tag) for r in (0.5, 1.0)]
        self._ellipses = PolyCollection(
            [],
            facecolors=[(*c, 0.10 if few else 0.02) for c in colours],
            edgecolors=[(*c, 0.85 if few else 0.3) for c in colours],
            linewidths=1.1 if few else 0.6,
            zorder=3,
        )
        axes.add_collection(self._ellipses, autolim=False)
        self._ellipses.set_clip_path(rings_clip(axes))
        self._dots = axes.scatter([], [], s=46 if few else 14, zorder=4)
        self._dots.set(facecolor=colours, edgecolor="white")

    def update(self, snapshot: Snapshot, alive: np.ndarray) -> None:
        """Show the estimates of UAVs in ``alive`` [N] that have a truth to compare with."""
        apart = np.where(alive[:, None], snapshot.estimate - snapshot.position, np.nan)
        offset = self._view(apart)
        radius = self._radius(np.linalg.norm(offset, axis=-1), 2 * snapshot.std)
        offset = offset / radius
        distance = np.linalg.norm(offset, axis=-1, keepdims=True)
        self._dots.set_offsets(offset / np.maximum(distance, 1.0))
        self._ellipses.set_verts(
            list(ellipses(self._view, apart / radius, snapshot.std / radius, 2.0))
        )
        for label, share in zip(self._labels, (0.5, 1.0), strict=True):
            label.set_text(metres(share * radius) if np.isfinite(distance).any() else "")

    def _radius(self, distance: np.ndarray, reach: np.ndarray) -> float:
        """A round radius in m that holds most estimates and their ellipses."""
        known = np.isfinite(distance)
        if not known.any():
            return 1.0
        typical = np.quantile(distance[known], 0.9), np.median(reach[known])
        return nice(max(1.15 * typical[0], 1.5 * typical[1], 1e-3))


def rings_clip(axes: Axes) -> Any:
    """The outer ring as a clip path."""
    from matplotlib.patches import Circle

    return Circle((0, 0), 1.0, transform=axes.transData)


def frame(axes: Axes) -> None:
    """A quiet frame: no box, small grey numbers."""
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.spines["bottom"].set_color(style.RULE)
    axes.tick_params(colors=style.MUTED, labelsize=9, length=0, pad=5)
