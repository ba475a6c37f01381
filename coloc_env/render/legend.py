"""The key at the foot of the picture."""

from typing import Any

from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D

from coloc_env.render import style
from coloc_env.render.snapshot import Snapshot
from coloc_env.scenario import Scenario


class Key:
    """The meaning of the marks; drawn again only when one of its words changes."""

    def __init__(self, figure: Figure, scenario: Scenario) -> None:
        self._figure, self._scenario = figure, scenario
        self._legend: Legend | None = None
        self._shown: tuple[Any, ...] = ()

    def update(self, snapshot: Snapshot, failures: bool, exaggeration: float) -> None:
        """Show what occurs in the picture."""
        shown = (
            exaggeration,
            snapshot.watching,
            snapshot.close_links,
            len(snapshot.landmarks) > 0,
            len(snapshot.anchors) > 0,
            failures,
        )
        if shown == self._shown:
            return
        self._shown = shown
        if self._legend is not None:
            self._legend.remove()
        handles = self._handles(*shown)
        self._legend = self._figure.legend(
            handles=handles,
            loc="lower left",
            bbox_to_anchor=(0.012, 0.004),
            ncols=len(handles),
            frameon=False,
            fontsize=9,
            labelcolor=style.MUTED,
            handlelength=1.5,
            handletextpad=0.5,
            columnspacing=1.35,
            borderaxespad=0.0,
        )

    def _handles(
        self,
        exaggeration: float,
        watching: int,
        close_links: bool,
        landmarks: bool,
        anchors: bool,
        failures: bool,
    ) -> list[Line2D]:
        colours = style.uav_colours(self._scenario.arena.n_uavs)
        colour = colours[max(watching, 0)]
        pale = style.tint(colour, 0.34)
        rim: dict[str, Any] = {"markerfacecolor": "white", "markeredgecolor": colour}
        oval: dict[str, Any] = {"markerfacecolor": (*colour, 0.13), "markeredgecolor": colour}
        size = "2σ" if exaggeration == 1 else f"2σ × {exaggeration:g}"
        items = [
            _mark("truth", "o", 9, color=colour, markeredgecolor="white"),
            _stroke("true path", color=pale, linewidth=4.5),
            _mark("estimate", "o", 6, **rim),
            _stroke("estimated path", color=colour, linewidth=1.2),
            _mark(f"covariance, {size}", "o", 12, **oval),
        ]
        if self._scenario.arena.n_uavs > 1:
            name = "links (three closest)" if close_links else "link"
            items.append(_stroke(name, color=style.LINK, linewidth=1.0))
        if landmarks:
            items.append(_mark("landmark", "D", 5, color=style.LANDMARK))
        if anchors:
            options = {"markerfacecolor": "white", "markeredgecolor": style.INK}
            items.append(_mark("anchor", "^", 7, **options))
        if (landmarks or anchors) and watching >= 0:
            dots = {"linestyle": (0, (1, 2.2)), "linewidth": 1.2}
            items.append(_stroke(f"seen by UAV {watching}", color=colour, **dots))
        if failures:
            items.append(_mark("failed", "X", 8, color=style.MUTED, markeredgecolor="white"))
        return items


def _mark(label: str, marker: str, size: float, **options: Any) -> Line2D:
    return Line2D([], [], linestyle="none", marker=marker, markersize=size, label=label, **options)


def _stroke(label: str, **options: Any) -> Line2D:
    return Line2D([], [], label=label, **options)
