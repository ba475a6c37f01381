"""What several scenario families are made of."""

import math

from coloc_env.motion import Kidnapped, Motion

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


def anchor_places(count: int, room: tuple[float, ...]) -> tuple[tuple[float, ...], ...]:
    """Anchors in the corners of a room (sides in m), then at the middles of its walls; in space
    alternately low and high."""
    spots = [(a * room[0], b * room[1]) for a, b in _SPOTS]
    places: list[tuple[float, ...]] = list(spots)
    if len(room) == 3:
        height = room[2]
        places = [(*spot, height * (i % 2)) for i, spot in enumerate(spots)]
        places += [(*spot, height - height * (i % 2)) for i, spot in enumerate(spots)]
    if not 1 <= count <= len(places):
        raise ValueError(f"anchors={count} is not allowed: 1 to {len(places)}")
    return tuple(places[:count])


def blocked_anchors(anchor: int | None) -> tuple[int, ...]:
    """``AnchorRanging.blocked`` for the one anchor that is (None: none)."""
    return () if anchor is None else (anchor,)


def kidnapped_at(
    motion: Motion, time: float | None, uavs: tuple[int, ...] | None, dt: float
) -> Motion:
    """The motion, its UAVs (None: all) kidnapped at ``time`` s (None: never)."""
    if time is None:
        if uavs is not None:
            raise ValueError(f"kidnapped={uavs} is not allowed: only with kidnap_at")
        return motion
    if not dt <= time < math.inf:
        raise ValueError(
            f"kidnap_at={time} is not allowed: a time in s, a step's {dt:g} s at least"
        )
    return Kidnapped(motion, round(time / dt), uavs)
