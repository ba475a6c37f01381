"""The whole picture: header, map panels, charts and legend on one figure."""

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from coloc_env.render import style
from coloc_env.render.charts import ErrorStrip, Target
from coloc_env.render.header import Header
from coloc_env.render.history import History
from coloc_env.render.legend import Key
from coloc_env.render.scene import MapPanel, Sizes
from coloc_env.render.shapes import HEIGHT, WIDTH, nice, plan, tilted
from coloc_env.render.snapshot import Snapshot
from coloc_env.scenario import Scenario


class Picture:
    """Draws one scenario on a figure of ``WIDTH`` x ``HEIGHT`` px; ``update`` shows a moment.

    What it shows depends on the arguments of the last ``update`` alone.
    """

    def __init__(self, figure: Figure, scenario: Scenario) -> None:
        self._figure, self._scenario = figure, scenario
        self._deep = scenario.arena.dim == 3
        with matplotlib.style.context(["default", style.FONT]):
            self._panels = self._add_panels()
            self._strip = self._add_strip()
            self._target = self._add_target()
            self._header = Header(figure, scenario)
        self._key = Key(figure, scenario)

    def update(self, snapshot: Snapshot, history: History, alive: np.ndarray) -> None:
        """Show ``snapshot`` with the ``history`` up to it; UAVs not in ``alive`` [N] as failed."""
        exaggeration = self._exaggeration(snapshot)
        for panel in self._panels:
            panel.update(snapshot, history, alive, exaggeration)
        self._strip.update(history)
        self._target.update(snapshot, alive)
        self._header.update(snapshot, history)
        with matplotlib.style.context(["default", style.FONT]):
            self._key.update(snapshot, not alive.all(), exaggeration)

    def _exaggeration(self, snapshot: Snapshot) -> float:
        """By how much ellipses must grow to stand out from the markers, a round number ≥ 1."""
        sizes = self._panels[0].pixels(snapshot.std)
        sizes = sizes[np.isfinite(sizes)]
        if not len(sizes):
            return 1.0
        visible = 1.5 * Sizes.of(self._scenario.arena.n_uavs, large=True).marker
        return max(1.0, nice(visible / max(float(np.median(sizes)), 1e-6)))

    # ---------------------------------------------------------------- panels

    def _axes(self, left: int, bottom: int, width: int, height: int, title: str) -> Axes:
        """A panel at a place in px, its title above."""
        at = left / WIDTH, (bottom + height + 10) / HEIGHT
        self._figure.text(*at, title, color=style.MUTED, size=10.5)
        place = (left / WIDTH, bottom / HEIGHT, width / WIDTH, height / HEIGHT)
        return self._figure.add_axes(place)

    def _add_panels(self) -> list[MapPanel]:
        scenario = self._scenario
        arena = scenario.arena
        dim = plan(arena.dim)
        if not self._deep:
            axes = self._axes(24, 262, 760, 400, "Map")
            return [MapPanel(axes, scenario, dim, (760, 400), large=True)]
        view = tilted(arena)
        axes = self._axes(24, 252, 760, 410, "Room")
        large = MapPanel(axes, scenario, view, (760, 410), large=True)
        axes = self._axes(812, 402, 364, 260, "From above")
        return [large, MapPanel(axes, scenario, dim, (364, 260), large=False)]

    def _add_strip(self) -> ErrorStrip:
        axes = self._axes(76, 78, 708, 140, "Position error")
        return ErrorStrip(axes, self._scenario.arena, self._scenario.horizon)

    def _add_target(self) -> Target:
        axes = self._axes(850, 66, 290, 290, "Estimates about the truth")
        return Target(axes, self._scenario.arena)
