"""Tables of compasses, signal strengths, lamps and ultrasound."""

from typing import Any

import numpy as np

from coloc_env.datasets.open_format import frames
from coloc_env.datasets.open_format.carried import REACH, Made
from coloc_env.datasets.open_format.columns import Columns
from coloc_env.datasets.open_format.description import Description
from coloc_env.datasets.open_format.truth import AXES, indices
from coloc_env.datasets.recording import Flags, Floats, Table

BEAMS = ("forward", "back", "left", "right", "up", "down")
_UNIT = 1e-3  # by which a direction's length may be off before it is made 1


def compass(found: Columns, about: Description) -> Made:
    """``heading``, as the truth has it."""
    heading = frames.heading(found.require("heading") * about.angle, about.frame)
    good = np.isfinite(heading[:, 0])
    over = good & (np.abs(heading[:, 0]) > np.pi)
    heading[over] = (heading[over] + np.pi) % (2 * np.pi) - np.pi
    return {"compass": _table(found, heading, ("heading",), good)}


def strengths(found: Columns, about: Description) -> Made:
    """``to, strength``: of an access point or another robot, dBm."""
    points = tuple(about.places["access_points"])
    to = indices(found, "to", (*about.robots, *points))
    if (own := to == about.robots.index(found.path.parent.name)).any():
        found.fail(own, "to", "is the robot itself")
    strength = found.require("strength")
    robots, good, made = len(about.robots), np.isfinite(strength[:, 0]), Made()
    for stream, end, among, first in (
        ("rssi", "point", to >= robots, robots),
        ("uav_rssi", "robot", to < robots, 0),
    ):
        if among.any():
            rows = found.rows(among)
            values = np.column_stack((to[among] - first, strength[among]))
            made[stream] = _table(rows, values, (end, "strength"), good[among])
    return made


def light(found: Columns, about: Description) -> Made:
    """``lamp, intensity, x, y, z``: lx, and the direction of the lamp in the body frame."""
    _require_space(found, about, "lamps")
    lamp = indices(found, "lamp", tuple(about.places["lamps"]))
    way = frames.body(found.require(*AXES), about.frame)
    intensity, length = found.require("intensity"), np.linalg.norm(way, axis=1)
    good = np.isfinite(intensity[:, 0]) & np.isfinite(length) & (length > 0)
    loose = good & (np.abs(length - 1) > _UNIT)
    way[loose] /= length[loose, None]
    values = np.column_stack((lamp, intensity, way))
    return {"light": _table(found, values, ("lamp", "intensity", *AXES), good)}


def echoes(found: Columns, about: Description) -> Made:
    """``forward, back, left, right, up, down``: m; a beam without echo is empty."""
    _require_space(found, about, "six beams")
    if not about.places["room"]:
        about.file.fail(("map",), "room: low and high corners are needed for ultrasound")
    values = found.require(*BEAMS) * about.length
    impossible = ~np.isnan(values) & ~((values > 0) & (values <= REACH))
    values[impossible] = np.nan
    table = Table(found.time, values, BEAMS)
    return {"ultrasonic": (table, int(impossible.any(1).sum()))}


def _table(
    found: Columns, values: Floats, columns: tuple[str, ...], good: Flags
) -> tuple[Table, int]:
    return Table(found.time[good], values[good], columns), int((~good).sum())


def _require_space(found: Columns, about: Description, what: str) -> None:
    if about.dim == 2:
        found.refuse(f"{what} are for 3 dimensions")


def room_of(corners: dict[str, Any]) -> dict[str, Floats]:
    """The low and the high corner of a box with two opposite ones."""
    if not corners:
        return {}
    both = np.stack([np.asarray(corner) for corner in corners.values()])
    return {"low": both.min(0), "high": both.max(0)}
