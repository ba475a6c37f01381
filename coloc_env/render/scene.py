"""The map panel: arena, UAVs, trails, estimates, links and landmarks, in one projection."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection, PolyCollection

from coloc_env.render import style
from coloc_env.render.history import History, trail_length
from coloc_env.render.shapes import (
    BOX_EDGES,
    BOX_FACES,
    View,
    corners,
    drop,
    ellipses,
    nice,
    placed,
)
from coloc_env.render.snapshot import Snapshot
from coloc_env.scenario import Scenario

_PIECE = 12  # steps of a trail drawn in one tint
_SIDES = 12  # of a column as it is drawn
_SHARE = 1.06  # of the arena that the panel shows


@dataclass(frozen=True)
class Sizes:
    """Sizes in px of a scene's marks; ``numbers`` is a type size in pt (0: no numbers)."""

    marker: float
    trail: float
    numbers: float

    @staticmethod
    def of(n_uavs: int, large: bool) -> "Sizes":
        """For a team of this size, in the large or the small panel."""
        if n_uavs <= 12:
            return Sizes(11.0, 6.0, 9.0) if large else Sizes(6.0, 3.5, 0.0)
        if n_uavs <= 60:
            return Sizes(6.0, 3.0, 0.0) if large else Sizes(3.6, 2.0, 0.0)
        return Sizes(3.6, 1.6, 0.0) if large else Sizes(2.4, 1.0, 0.0)


class MapPanel:
    """One view of the world on an axes of ``size`` px; ``update`` moves its artists in place."""

    def __init__(
        self, axes: Axes, scenario: Scenario, view: View, size: tuple[float, float], large: bool
    ) -> None:
        arena = scenario.arena
        self._axes, self._view, self._deep = axes, view, arena.dim == 3 and view.matrix[1, 2] != 0
        self._low, self._high = _box(arena.low), _box(arena.high)
        self._flat = View(np.pad(view.matrix, ((0, 0), (0, 3 - arena.dim))), view.stretch)
        self.scale = self._fit(size)
        self._sizes = Sizes.of(arena.n_uavs, large)
        self._colours = style.uav_colours(arena.n_uavs)
        self._drop = drop(1.75 if self._sizes.numbers else 2.2)
        self._draw_arena(scenario)
        self._add_marks(arena.n_uavs)
        self._add_uavs(arena.n_uavs)

    def _fit(self, size: tuple[float, float]) -> float:
        """Set the limits so that the arena fills the panel, both axes alike; returns px per m."""
        outline = self._flat(corners(self._low, self._high))
        low, high = outline.min(0), outline.max(0)
        scale = float(np.min(np.array(size) / (high - low)) / _SHARE)
        half = 0.5 * np.array(size) / scale
        centre = 0.5 * (low + high)
        self._axes.set_xlim(centre[0] - half[0], centre[0] + half[0])
        self._axes.set_ylim(centre[1] - half[1], centre[1] + half[1])
        self._axes.axis("off")
        return scale

    # ---------------------------------------------------------------- what stands still

    def _draw_arena(self, scenario: Scenario) -> None:
        low, high = self._low, self._high
        faces = [np.where([1, 1, 0], corners(low, high), low)[[0, 1, 3, 2]]]
        if self._deep:  # the two walls at the back
            faces += [corners(low, high)[BOX_FACES[4]][:, :], corners(low, high)[BOX_FACES[3]]]
        shades = [style.FLOOR, style.BACK, style.BACK]
        self._polygons(faces, facecolors=shades[: len(faces)], edgecolors="none", zorder=0)
        self._lines(self._grid(), colors=style.GRID, linewidths=0.8, zorder=0.1)
        edges = corners(low, high)[BOX_EDGES]
        top = (edges[..., 2] == high[2]).any(-1) & self._deep
        self._lines(edges[~top], colors=style.MUTED, linewidths=1.0, zorder=0.2)
        self._lines(edges[top], colors=style.RULE, linewidths=0.9, zorder=0.2)
        for wall in scenario.network.walls:
            box = corners(_box(wall[0]), _box(wall[1]))
            options: dict[str, Any] = {"facecolors": (*style.rgb(style.WALL), 0.28), "zorder": 3.0}
            shown = BOX_FACES if self._deep else BOX_FACES[1:2]
            self._polygons(list(box[shown]), edgecolors=style.WALL, linewidths=0.7, **options)
        self._radius = scenario.sight.radius
        self._columns = PolyCollection([], facecolors=style.WALL, alpha=0.35, zorder=3.1)
        self._axes.add_collection(self._columns, autolim=False)

    def _grid(self) -> np.ndarray:
        """Lines [M, 2, 3] on the floor, ``spacing`` apart."""
        low, high, lines = self._low, self._high, []
        for axis in (0, 1):
            at = np.arange(low[axis] + self.spacing, high[axis] - 1e-6, self.spacing)
            line = np.stack((np.tile(low, (len(at), 1)), np.tile(high, (len(at), 1))), 1)
            line[..., axis] = at[:, None]
            line[..., 2] = low[2]
            lines.append(line)
        return np.concatenate(lines)

    @property
    def spacing(self) -> float:
        """Distance of the floor's grid lines, m."""
        return nice(float((self._high - self._low)[:2].max()) / 12)

    def _polygons(self, faces: list[np.ndarray], **options: Any) -> None:
        self._axes.add_collection(
            PolyCollection([self._flat(f) for f in faces], **options), autolim=False
        )

    def _lines(self, lines: np.ndarray, **options: Any) -> LineCollection:
        made = LineCollection(list(self._flat(lines)), **options)
        self._axes.add_collection(made, autolim=False)
        return made

    # ---------------------------------------------------------------- what moves

    def _add_marks(self, n_uavs: int) -> None:
        """Landmarks, anchors, links and rays."""
        size = 26.0 if n_uavs <= 60 else 12.0
        self._landmarks = self._dots(
            "D", size * 0.8, 2.0, facecolor=style.LANDMARK, edgecolor="none"
        )
        self._seen = self._dots("D", size * 0.8, 2.1, facecolor=style.INK, edgecolor="none")
        self._anchors = self._dots("^", size * 2, 2.2, facecolor="white", edgecolor=style.INK)
        none = np.empty((0, 2, 3))
        self._rays = self._lines(none, linestyles=(0, (1, 2.2)), linewidths=1.0, zorder=2.3)
        thin = 0.8 if n_uavs <= 60 else 0.5
        self._links = self._lines(none, colors=style.LINK, linewidths=thin, alpha=0.55, zorder=2.4)

    def _add_uavs(self, n_uavs: int) -> None:
        colours, sizes, none = self._colours, self._sizes, np.empty((0, 2, 3))
        strength = np.linspace(0, 1, -(-trail_length(n_uavs) // _PIECE) + 1)[1:]
        wide = style.tint(colours[:, None], 0.34 * strength).reshape(-1, 3)
        thin = style.tint(colours[:, None], strength).reshape(-1, 3)
        butt: dict[str, Any] = {"capstyle": "round"}
        self._truth = self._lines(
            none, colors=wide, linewidths=_pt(sizes.trail), zorder=2.5, **butt
        )
        self._guess = self._lines(
            none, colors=thin, linewidths=_pt(max(0.22 * sizes.trail, 0.8)), zorder=2.6, **butt
        )
        self._stems = self._lines(
            none, colors=style.tint(colours, 0.5), linewidths=0.9, zorder=2.45
        )
        self._ellipses = PolyCollection(
            [],
            facecolors=[(*c, 0.13) for c in colours],
            edgecolors=[(*c, 0.9) for c in colours],
            linewidths=1.0 if n_uavs <= 60 else 0.6,
            zorder=4.0,
        )
        self._errors = self._lines(none, colors=colours, linewidths=1.1, zorder=4.1)
        self._estimates = self._dots(
            "o", (0.62 * sizes.marker) ** 2, 4.2, facecolor="white", edgecolor=colours
        )
        self._markers = PolyCollection(
            [], facecolors=colours, edgecolors="white", linewidths=0.9, zorder=5.0
        )
        for artist in (self._ellipses, self._markers):
            self._axes.add_collection(artist, autolim=False)
        self._crosses = self._dots(
            "X", (2.0 * sizes.marker) ** 2 / 2, 5.1, facecolor=colours, edgecolor="white"
        )
        options: dict[str, Any] = {"color": "white", "weight": "bold", "zorder": 6.0}
        options |= {"ha": "center", "va": "center_baseline", "fontsize": sizes.numbers or 1.0}
        count = n_uavs if sizes.numbers else 0
        self._numbers = [self._axes.text(0, 0, str(i), **options) for i in range(count)]

    def _dots(self, marker: str, area: float, zorder: float, **options: Any) -> PathCollection:
        dots = self._axes.scatter([], [], s=area, marker=marker, zorder=zorder, linewidths=1.1)
        dots.set(**options)
        return dots

    # ---------------------------------------------------------------- one frame

    def update(
        self, snapshot: Snapshot, history: History, alive: np.ndarray, exaggeration: float
    ) -> None:
        """Show ``snapshot``; UAVs not in ``alive`` [N] as crosses where they were seen last;
        2-σ ellipses ``exaggeration`` times as large as they are."""
        view = self._view
        alive_at = np.where(alive[:, None], snapshot.position, np.nan)
        at = view(alive_at)
        here = np.isfinite(at[:, 0])
        self._landmarks.set_offsets(view(snapshot.landmarks))
        self._anchors.set_offsets(view(snapshot.anchors))
        self._seen.set_offsets(view(snapshot.seen))
        self._columns.set_verts([self._flat(f) for f in self._sides(snapshot.obstacles)])
        self._show_links(snapshot, alive_at)
        self._truth.set_segments(list(_pieces(view(history.truth))))
        self._guess.set_segments(list(_pieces(view(history.estimate))))
        if self._deep:
            foot = alive_at.copy()
            foot[:, 2] = self._low[2]
            self._stems.set_segments(list(np.stack((at, view(foot)), 1)))
        known = np.isfinite(snapshot.estimate[:, 0]) & alive
        estimate = np.where(known[:, None], snapshot.estimate, np.nan)
        self._ellipses.set_verts(list(ellipses(view, estimate, snapshot.std, 2 * exaggeration)))
        self._errors.set_segments(list(np.stack((at, view(estimate)), 1)))
        self._estimates.set_offsets(view(estimate))
        size = self._sizes.marker / self.scale
        self._markers.set_verts(list(placed(self._drop, at, view.angle(snapshot.ahead), size)))
        self._crosses.set_offsets(np.where(alive[:, None], np.nan, view(history.last_seen)))
        for number, place, shown in zip(self._numbers, at, here, strict=False):
            number.set_visible(bool(shown))
            number.set_position(place)

    def _sides(self, obstacles: np.ndarray) -> list[np.ndarray]:
        """Faces of the columns about axes [C, d]: the sides, or in the plane the base."""
        turn = np.linspace(0, 2 * np.pi, _SIDES + 1)
        rim = self._radius * np.stack((np.cos(turn), np.sin(turn)), -1)
        faces = []
        for x, y, *_ in obstacles:
            ring = rim + np.array((x, y))
            low, high = (
                np.column_stack((ring, np.full(len(rim), z))) for z in (self._low[2], self._high[2])
            )
            if not self._deep:
                faces.append(low)
                continue
            faces += [np.stack((low[i], low[i + 1], high[i + 1], high[i])) for i in range(_SIDES)]
        return faces

    def _show_links(self, snapshot: Snapshot, alive_at: np.ndarray) -> None:
        ends = self._view(alive_at)
        self._links.set_segments(list(ends[snapshot.links]))
        seen = self._view(snapshot.seen)
        start = np.broadcast_to(ends[snapshot.watching], seen.shape)
        self._rays.set_segments(list(np.stack((start, seen), 1)))
        self._rays.set_color(self._colours[snapshot.watching])

    def pixels(self, std: np.ndarray) -> np.ndarray:
        """Longer half axes [N] in px of the 2-σ ellipses of standard deviations [N, d] in m."""
        outline = ellipses(self._view, np.zeros_like(std), std, 2.0)
        return self.scale * np.linalg.norm(outline, axis=-1).max(-1)


def _pieces(paths: np.ndarray) -> np.ndarray:
    """Paths [T, N, 2] cut into pieces [N · P, S + 1, 2] that share their ends, the newest last."""
    length, n, _ = paths.shape
    count = -(-length // _PIECE)
    index = length - 1 - np.arange(count * _PIECE, -1, -1)
    index = np.lib.stride_tricks.sliding_window_view(np.maximum(index, 0), _PIECE + 1)[::_PIECE]
    return paths[index].transpose(2, 0, 1, 3).reshape(n * count, _PIECE + 1, 2)


def _box(point: tuple[float, ...]) -> np.ndarray:
    """A corner in three dimensions; a plane lies at height 0."""
    return np.array([*point, 0.0][:3])


def _pt(px: float) -> float:
    """Pixels at 100 dpi in points."""
    return 0.72 * px
