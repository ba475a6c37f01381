"""Tables of time differences, angles of arrival and optical flow."""

import numpy as np

from coloc_env.datasets.open_format import frames
from coloc_env.datasets.open_format.columns import Columns
from coloc_env.datasets.open_format.description import Description
from coloc_env.datasets.open_format.truth import indices
from coloc_env.datasets.recording import Floats, Table

REACH = 1000.0  # m, of anything that measures a distance
Made = dict[str, tuple[Table, int]]


def tags_of(found: Columns, about: Description, column: str) -> Floats:
    """The tag [T] of each row by a column, counted from 0; the first where there is no column."""
    tag = found.numbers.get(column, np.zeros(len(found)))
    most = max(1, about.tags.shape[1])
    if (bad := (tag != np.rint(tag)) | (tag < 0) | (tag >= most)).any():
        found.fail(bad, column, f"is no tag from 0 to {most - 1}")
    return tag


def differences(found: Columns, about: Description) -> Made:
    """``from, to, difference[, own_tag]``: how much farther ``to`` is than ``from``."""
    ends = [indices(found, column, tuple(about.anchors)) for column in ("from", "to")]
    if (same := ends[0] == ends[1]).any():
        found.fail(same, "to", "is from itself")
    difference = found.require("difference")[:, 0] * about.length
    good = np.abs(difference) <= REACH
    values = np.column_stack((tags_of(found, about, "own_tag"), *ends, difference))[good]
    columns = ("own_tag", "from", "to", "difference")
    return {"tdoa": (Table(found.time[good], values, columns), int((~good).sum()))}


def angles(found: Columns, about: Description) -> Made:
    """``robot, azimuth, elevation``, in the body frame."""
    if about.dim == 2:
        found.refuse("azimuth and elevation are for 3 dimensions; use range and bearing")
    robot = indices(found, "robot", about.robots)
    if (own := robot == about.robots.index(found.path.parent.name)).any():
        found.fail(own, "robot", "is the robot itself")
    values = frames.turn(found.require("azimuth", "elevation") * about.angle, about.frame)
    good = np.isfinite(values).all(1)
    for i, (column, most, what) in enumerate(
        (("azimuth", 2 * np.pi, "a whole turn"), ("elevation", 0.5 * np.pi + 1e-9, "upright"))
    ):
        beyond = np.isfinite(values[:, i]) & (np.abs(values[:, i]) > most)
        if beyond.any():
            found.fail(beyond, column, f"is more than {what}: see units.angle")
    over = good & (np.abs(values[:, 0]) > np.pi)
    values[over, 0] = (values[over, 0] + np.pi) % (2 * np.pi) - np.pi
    rows = np.column_stack((robot, values))[good]
    columns = ("robot", "azimuth", "elevation")
    return {"arrival_angles": (Table(found.time[good], rows, columns), int((~good).sum()))}


def flow(found: Columns, about: Description) -> Made:
    """``vx, vy``, in the body frame."""
    if about.dim == 2:
        found.refuse("optical flow is for 3 dimensions; use odometry")
    values = frames.body(found.require("vx", "vy") * about.length, about.frame)
    good = np.isfinite(values).all(1)
    return {"flow": (Table(found.time[good], values[good], ("vx", "vy")), int((~good).sum()))}
