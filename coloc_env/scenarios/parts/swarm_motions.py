"""Motions of ``swarm-v0``."""

import math
from typing import Literal

from coloc_env.motion import (
    Box,
    Motion,
    RandomCircles,
    RandomHelices,
    RandomVelocity,
    Weave,
)

SwarmMotion = Literal["random", "line", "circle", "helix", "weave"]

_ACCELERATION = 15.0  # m/s², at most, of those that turn
_RATE = 0.5  # rad/s, at most, of circles
_WEAVE = 17 / 16  # largest acceleration of a figure of eight, of speed² / half-length
_NARROWEST_WEAVE = 100.0  # m, half-length at low speeds
_MARGIN = 0.5  # m kept from the walls


def swarm_motion(
    kind: SwarmMotion, v_max: float, boxes: tuple[Box, ...], size: tuple[float, float, float]
) -> Motion:
    """The motion of a kind, at speeds up to ``v_max`` m/s, in ``boxes`` or, if none, in ``size`` m.

    Accelerations are at most 15 m/s², wall reflections and the new targets of ``random`` apart.
    Raises ValueError for a speed at which turns of that acceleration do not fit the boxes.
    """
    if kind == "random":
        return RandomVelocity(v_max, boxes=boxes)
    if kind == "line":
        return RandomVelocity(v_max, interval=math.inf, boxes=boxes)
    if kind == "weave":
        return _weave(v_max, boxes, size)
    share = 1.0 if kind == "circle" else 0.9  # of a helix: 0.9² + 0.4² < 1
    tightest = max(v_max**2 / _ACCELERATION, v_max / _RATE)
    circles = RandomCircles(
        speed=(0.1 * v_max, share * v_max),
        radius=(tightest, _widest(kind, v_max, tightest, 4 * tightest, boxes, size)),
        height_amplitude=(0.0, 0.0),
        margin=_MARGIN,
        boxes=boxes,
    )
    return circles if kind == "circle" else RandomHelices(circles, (0.05 * v_max, 0.4 * v_max))


def _weave(v_max: float, boxes: tuple[Box, ...], size: tuple[float, float, float]) -> Weave:
    tightest = max(_WEAVE * v_max**2 / _ACCELERATION, _NARROWEST_WEAVE)
    longest = _widest("weave", v_max, tightest, 1.5 * tightest, boxes, size)
    return Weave(
        speed=(0.5 * v_max, v_max),
        half_length=(tightest, longest),
        height_amplitude=(0.0, min(0.2 * tightest, 0.5 * size[2] - _MARGIN)),
        margin=_MARGIN,
        boxes=boxes,
    )


def _widest(
    kind: str,
    v_max: float,
    tightest: float,
    wanted: float,
    boxes: tuple[Box, ...],
    size: tuple[float, float, float],
) -> float:
    """The largest turn (m) up to the one wanted that fits every box."""
    spaces = boxes or (((0.0, 0.0, 0.0), size),)
    side = min(high[axis] - low[axis] for low, high in spaces for axis in (0, 1))
    fitting = 0.5 * side - _MARGIN
    if tightest > fitting:
        raise ValueError(
            f"v_max={v_max} is not allowed with motion={kind!r}: its curves reach {tightest:g} m "
            f"from their centres, and the narrowest box has room for {fitting:g} m"
        )
    return min(wanted, fitting)
