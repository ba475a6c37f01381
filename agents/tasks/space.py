"""Where tasks play: the plane, or, for their ``-hard`` variants, a space with walls."""

from dataclasses import dataclass

from coloc_env.motion import Arena, Box

_HEIGHT = 20.0  # m
_WALL = 12.0  # m: how high walls are
_MASTS = (2.0, 14.0, 8.0)  # m: heights of anchors, in turns
_LOW, _OVER = (2.0, 10.0), (13.0, 18.0)  # m: between which heights UAVs start, and roam over walls
CRUISE = 15.0  # m: the height that heuristics go at

Flat = tuple[float, float]
FlatBox = tuple[Flat, Flat]


@dataclass(frozen=True)
class Space:
    """The plane of ``size`` m; where ``hard`` a space 20 m high, with ``walls`` of 12 m on these
    rectangles that neither UAVs nor signals pass."""

    size: Flat
    hard: bool
    rectangles: tuple[FlatBox, ...] = ()

    @property
    def walls(self) -> tuple[Box, ...]:
        if not self.hard:
            return ()
        return tuple(((*low, 0.0), (*high, _WALL)) for low, high in self.rectangles)

    def arena(self, n_uavs: int) -> Arena:
        """For so many UAVs, in steps of 1 s."""
        low, high = (0.0, 0.0), self.size
        if self.hard:
            return Arena(3, n_uavs, 1.0, (*low, 0.0), (*high, _HEIGHT))
        return Arena(2, n_uavs, 1.0, low, high)

    def anchors(self, places: tuple[Flat, ...]) -> tuple[tuple[float, ...], ...]:
        """Anchors on masts of several heights."""
        if not self.hard:
            return places
        return tuple((*place, _MASTS[i % len(_MASTS)]) for i, place in enumerate(places))

    def start(self, low: Flat, high: Flat) -> Box:
        """A box in which to start, near the ground."""
        return self._box(low, high, _LOW)

    def over(self, low: Flat = (0.0, 0.0), high: Flat | None = None) -> Box:
        """A box above all walls."""
        return self._box(low, high or self.size, _OVER)

    def _box(self, low: Flat, high: Flat, heights: Flat) -> Box:
        return ((*low, heights[0]), (*high, heights[1])) if self.hard else (low, high)
