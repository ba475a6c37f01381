"""Fixed UWB anchors in a room."""

from dataclasses import dataclass
from typing import ClassVar

from coloc_env.options import Count, Group
from coloc_env.sensors import AnchorRanging, RangeNoise

_SPOTS = (
    (0.0, 0.0),
    (1.0, 1.0),
    (1.0, 0.0),
    (0.0, 1.0),
    (0.5, 0.0),
    (0.5, 1.0),
    (0.0, 0.5),
    (1.0, 0.5),
)


@dataclass(frozen=True)
class AnchorOptions(Group):
    """So many ``anchors``, at known places in the room's corners, then along its walls, measure
    their distances to all UAVs. Every range to number ``nlos_anchor`` has the bias of NLOS."""

    title: ClassVar[str] = "anchors"

    anchors: Count = 0
    nlos_anchor: Count | None = None

    def true(self, room: tuple[float, ...], noise: RangeNoise) -> AnchorRanging:
        """The sensor as it is, in a room with sides in m."""
        blocked = () if self.nlos_anchor is None else (self.nlos_anchor,)
        return AnchorRanging(self._places(room), noise, blocked=blocked)

    def believed(self, room: tuple[float, ...], noise: RangeNoise) -> AnchorRanging:
        """The sensor that the team believes in."""
        return AnchorRanging(self._places(room), noise)

    def _places(self, room: tuple[float, ...]) -> tuple[tuple[float, ...], ...]:
        """Positions (m); in space alternately low and high."""
        spots = [(a * room[0], b * room[1]) for a, b in _SPOTS]
        places: list[tuple[float, ...]] = list(spots)
        if len(room) == 3:
            height = room[2]
            places = [(*spot, height * (i % 2)) for i, spot in enumerate(spots)]
            places += [(*spot, height - height * (i % 2)) for i, spot in enumerate(spots)]
        if not 1 <= self.anchors <= len(places):
            raise ValueError(f"anchors={self.anchors} is not allowed: 1 to {len(places)}")
        return tuple(places[: self.anchors])
