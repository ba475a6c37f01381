"""Fixed UWB anchors in a room."""

from dataclasses import dataclass, replace
from typing import ClassVar

from coloc_env.motion import Box
from coloc_env.options import Count, Group, Metres, PositiveMetres, Seconds, Share
from coloc_env.sensors import AnchorRanging, RangeNoise, Rssi, RssiOptions, Tdoa, UavRssi
from coloc_env.sensors.ranging import AnchorOffset, Tags

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
    their distances to all UAVs. Every range to number ``nlos_anchor`` has the bias of NLOS. All
    ranges to the first ``biased_anchors`` are ``anchor_bias`` m too long, which nobody believes; it
    grows linearly from 0 over the first ``anchor_bias_rise`` s."""

    title: ClassVar[str] = "anchors"

    anchors: Count = 0
    nlos_anchor: Count | None = None
    biased_anchors: Count = 0
    anchor_bias: Metres = 1.0
    anchor_bias_rise: Seconds = 0.0

    def true(self, room: tuple[float, ...], noise: RangeNoise, tags: Tags = ()) -> AnchorRanging:
        """The sensor as it is, in a room with sides in m, to tags with lever arms."""
        blocked = () if self.nlos_anchor is None else (self.nlos_anchor,)
        places = anchor_places("anchors", self.anchors, room)
        offset = AnchorOffset(self.biased_anchors, self.anchor_bias, self.anchor_bias_rise)
        return AnchorRanging(places, noise, tags, blocked=blocked, offset=offset)

    def believed(
        self, room: tuple[float, ...], noise: RangeNoise, tags: Tags = ()
    ) -> AnchorRanging:
        """The sensor that the team believes in."""
        return AnchorRanging(anchor_places("anchors", self.anchors, room), noise, tags)


@dataclass(frozen=True)
class TdoaOptions(Group):
    """So many ``tdoa_anchors`` send in turn, placed as ``anchors`` are; UAVs only listen, and
    measure how much farther each is than the one before, with noise of ``tdoa_std`` m, where both
    lie within ``tdoa_radius`` m (none: always). A share ``tdoa_dropout`` is missing; a share
    ``tdoa_tail`` has noise of ``tdoa_tail_std`` m instead, which the team does not believe in."""

    title: ClassVar[str] = "time differences of arrival"

    tdoa_anchors: Count = 0
    tdoa_std: Metres = 0.15
    tdoa_radius: PositiveMetres | None = None
    tdoa_dropout: Share = 0.0
    tdoa_tail: Share = 0.0
    tdoa_tail_std: Metres = 1.0

    def true(self, room: tuple[float, ...], tags: Tags = ()) -> tuple[Tdoa, ...]:
        """The sensor as it is, in a room with sides in m, at tags with lever arms; nothing without
        anchors."""
        tail, wide = self.tdoa_tail, self.tdoa_tail_std
        return tuple(replace(t, tail=tail, tail_std=wide) for t in self.believed(room, tags))

    def believed(self, room: tuple[float, ...], tags: Tags = ()) -> tuple[Tdoa, ...]:
        """The sensor that the team believes in."""
        if not self.tdoa_anchors:
            return ()
        if self.tdoa_anchors == 1:
            raise ValueError("tdoa_anchors=1 is not allowed: a difference is of two")
        places = anchor_places("tdoa_anchors", self.tdoa_anchors, room)
        lost, near = self.tdoa_dropout, self.tdoa_radius
        return (Tdoa(places, self.tdoa_std, tags, dropout=lost, radius=near),)


def signal_strengths(
    options: RssiOptions, room: tuple[float, ...], walls: tuple[Box, ...]
) -> tuple[Rssi | UavRssi, ...]:
    """The signal strengths that options ask for, in a room with sides in m with walls in it."""
    loss, dropout = options.loss(walls), options.rssi_dropout
    found: list[Rssi | UavRssi] = []
    if options.rssi:
        places = anchor_places("access_points", options.access_points, room)
        found.append(Rssi(places, loss, dropout))
    if options.rssi_uavs:
        found.append(UavRssi(loss, dropout))
    return tuple(found)


def anchor_places(
    option: str, count: int, room: tuple[float, ...]
) -> tuple[tuple[float, ...], ...]:
    """Positions (m) of so many anchors in a room with sides in m; in space alternately low and
    high. ValueError, which names the ``option``, for more than there are places."""
    spots = [(a * room[0], b * room[1]) for a, b in _SPOTS]
    places: list[tuple[float, ...]] = list(spots)
    if len(room) == 3:
        height = room[2]
        places = [(*spot, height * (i % 2)) for i, spot in enumerate(spots)]
        places += [(*spot, height - height * (i % 2)) for i, spot in enumerate(spots)]
    if not 1 <= count <= len(places):
        raise ValueError(f"{option}={count} is not allowed: 1 to {len(places)}")
    return tuple(places[:count])
