"""What the smoother adds up: residuals of motion and measurements, and their derivatives."""

from dataclasses import dataclass

import numpy as np

from coloc_env.datasets.grid import Grid, odometry_on
from coloc_env.datasets.noise_model import NoiseModel
from coloc_env.datasets.recording import Floats, Recording, Stamps, Table
from coloc_env.datasets.residuals import Link, links_of

DT = 0.2  # s between knots
_BIAS = 0.1  # m: standard deviation of a link's bias before anything is measured
Rows = list["Factor"]


@dataclass(frozen=True, eq=False)
class Factor:
    """Residuals [T] in standard deviations and their derivatives: [T, c] by unknowns [T, c]."""

    residual: Floats
    jacobian: Floats
    columns: np.ndarray
    robust: bool = True


class Unknowns:
    """Where each unknown stands in the vector of all."""

    def __init__(self, recording: Recording, grid: Grid, links: list[str], turning: bool) -> None:
        self.dim, self.robots, self.knots = recording.dim, len(recording.robots), grid.count
        self.turning = turning
        self.places = self.robots * self.knots * self.dim
        self.headings = self.robots * self.knots if turning else 0
        self.size = self.places + self.headings + len(links)
        self.link = {name: self.places + self.headings + i for i, name in enumerate(links)}

    def place(self, robot: int, knot: np.ndarray) -> np.ndarray:
        """Columns [T, d]."""
        first = (robot * self.knots + knot) * self.dim
        return first[:, None] + np.arange(self.dim)

    def heading(self, robot: int, knot: np.ndarray) -> np.ndarray:
        """Columns [T]."""
        return self.places + robot * self.knots + knot


def factors(recording: Recording, model: NoiseModel, grid: Grid, at: Unknowns, x: Floats) -> Rows:
    """All residuals at ``x``."""
    found: Rows = []
    for robot in range(at.robots):
        if at.turning:
            table = recording.streams["odometry"][robot]
            found += _driven(odometry_on(grid, table) * DT, model, at, robot, x)
        else:
            found.append(_coasting(model, at, robot, x))
    for stream, std in (
        ("anchor_ranges", model.anchor_ranges.std),
        ("uav_ranges", model.uav_ranges.std),
    ):
        for link in links_of(recording, stream):
            found.append(_range(recording, link, grid, at, x, std))
    for column in at.link.values():
        prior = np.array([x[column] / _BIAS])
        found.append(Factor(prior, np.array([[1 / _BIAS]]), np.array([[column]]), False))
    for robot in range(at.robots):
        if "landmark_bearings" in recording.streams:
            table = recording.streams["landmark_bearings"][robot]
            found += _sighted(recording, table, model, grid, at, robot, x)
        for stream, first, std in (
            ("height", 2, model.height.std),
            ("position_fix", 0, model.position_fix.std),
        ):
            if stream in recording.streams:
                found += _coordinates(
                    recording.streams[stream][robot], grid, at, robot, x, first, std
                )
    return [each for each in found if len(each.residual)]


def _knots(grid: Grid, time: Stamps) -> tuple[np.ndarray, Floats, np.ndarray]:
    """The knot before each time, how far on to the next it is, and which times lie between two."""
    share = (time - grid.start) * 1e-9 / grid.dt
    knot = np.floor(share).astype(np.int64)
    inside = (knot >= 0) & (knot < grid.count - 1)
    return knot.clip(0, grid.count - 2), share - knot, inside


def _between(x: Floats, at: Unknowns, robot: int, knot: np.ndarray, share: Floats) -> Floats:
    """Places [T, d] between knots."""
    before, after = x[at.place(robot, knot)], x[at.place(robot, knot + 1)]
    return before + share[:, None] * (after - before)


def _by_place(unit: Floats, share: Floats) -> Floats:
    """Derivatives [T, 2d] by the places at both knots."""
    return np.concatenate((unit * (1 - share[:, None]), unit * share[:, None]), 1)


def _place_columns(at: Unknowns, robot: int, knot: np.ndarray) -> np.ndarray:
    return np.concatenate((at.place(robot, knot), at.place(robot, knot + 1)), 1)


def _range(
    recording: Recording, link: Link, grid: Grid, at: Unknowns, x: Floats, std: float
) -> Factor:
    """r = ‖p − q‖ + b."""
    knot, share, inside = _knots(grid, link.time)
    knot, share, measured = knot[inside], share[inside], link.measured[inside]
    own = _between(x, at, link.robot, knot, share)
    other = recording.anchors[link.other]
    if not link.to_anchor:
        other = _between(x, at, link.other, knot, share)
    apart = own - other
    distance = np.maximum(np.linalg.norm(apart, axis=1), 1e-3)
    unit = apart / distance[:, None]
    column = at.link[link.name]
    residual = (distance + x[column] - measured) / std
    parts = [_by_place(unit, share), np.ones((len(knot), 1))]
    columns = [_place_columns(at, link.robot, knot), np.full((len(knot), 1), column)]
    if not link.to_anchor:
        parts.append(_by_place(-unit, share))
        columns.append(_place_columns(at, link.other, knot))
    return Factor(residual, np.concatenate(parts, 1) / std, np.concatenate(columns, 1))


def _coasting(model: NoiseModel, at: Unknowns, robot: int, x: Floats) -> Factor:
    """p₊ − 2 p + p₋ = 0, of variance ⅔ q² dt³ (white acceleration q)."""
    knots = np.arange(1, at.knots - 1)
    std = model.motion.accel_std * (2 / 3 * DT**3) ** 0.5
    columns = np.stack([at.place(robot, knots + i) for i in (-1, 0, 1)], -1)
    bend = x[columns] @ np.array((1.0, -2.0, 1.0))
    jacobian = np.tile(np.array((1.0, -2.0, 1.0)) / std, (bend.size, 1))
    return Factor(bend.ravel() / std, jacobian, columns.reshape(-1, 3), False)


def _driven(moved: Floats, model: NoiseModel, at: Unknowns, robot: int, x: Floats) -> Rows:
    """p₊ = p + R(θ) u and θ₊ = θ + ω, with the odometry's noise."""
    knots = np.arange(at.knots - 1)
    step = moved[1:]
    wheels = model.odometry
    slack = DT * (0.1 / DT) ** 0.5  # noise is that of steps of 0.1 s
    ahead = slack * (wheels.forward_std + wheels.relative * np.abs(step[:, 0]) / DT) + 1e-4
    turn = slack * (wheels.turn_std + wheels.relative * np.abs(step[:, 2]) / DT) + 1e-4
    angle = x[at.heading(robot, knots)]
    c, s = np.cos(angle), np.sin(angle)
    by_turn = np.stack((-s * step[:, 0] - c * step[:, 1], c * step[:, 0] - s * step[:, 1]), 1)
    gone = np.stack((c * step[:, 0] - s * step[:, 1], s * step[:, 0] + c * step[:, 1]), 1)
    before, after = at.place(robot, knots), at.place(robot, knots + 1)
    found = []
    for axis in (0, 1):
        residual = (x[after[:, axis]] - x[before[:, axis]] - gone[:, axis]) / ahead
        one = np.ones(len(knots))
        jacobian = np.stack((one, -one, -by_turn[:, axis]), 1) / ahead[:, None]
        columns = np.stack((after[:, axis], before[:, axis], at.heading(robot, knots)), 1)
        found.append(Factor(residual, jacobian, columns))
    columns = np.stack((at.heading(robot, knots + 1), at.heading(robot, knots)), 1)
    residual = (x[columns[:, 0]] - x[columns[:, 1]] - step[:, 2]) / turn
    jacobian = np.tile((1.0, -1.0), (len(knots), 1)) / turn[:, None]
    return [*found, Factor(residual, jacobian, columns)]


def _sighted(
    recording: Recording,
    table: Table,
    model: NoiseModel,
    grid: Grid,
    at: Unknowns,
    robot: int,
    x: Floats,
) -> Rows:
    """Range and bearing to landmarks."""
    knot, share, inside = _knots(grid, table.time)
    knot, share, seen = knot[inside], share[inside], table.values[inside]
    apart = recording.landmarks[seen[:, 0].astype(np.int64)] - _between(x, at, robot, knot, share)
    distance = np.maximum(np.linalg.norm(apart, axis=1), 1e-3)
    turns = np.stack((at.heading(robot, knot), at.heading(robot, knot + 1)), 1)
    angle = x[turns[:, 0]] + share * (x[turns[:, 1]] - x[turns[:, 0]])
    bearing = np.arctan2(apart[:, 1], apart[:, 0]) - angle
    off = (bearing - seen[:, 2] + np.pi) % (2 * np.pi) - np.pi
    places = _place_columns(at, robot, knot)
    std = model.landmark_bearings.range_std
    along = _by_place(-apart / distance[:, None], share) / std
    ranges = Factor((distance - seen[:, 1]) / std, along, places)
    std = model.landmark_bearings.bearing_std
    across = np.stack((apart[:, 1], -apart[:, 0]), 1) / (distance**2)[:, None]
    by_turn = -np.stack((1 - share, share), 1)
    jacobian = np.concatenate((_by_place(across, share), by_turn), 1) / std
    return [ranges, Factor(off / std, jacobian, np.concatenate((places, turns), 1))]


def _coordinates(
    table: Table, grid: Grid, at: Unknowns, robot: int, x: Floats, first: int, std: float
) -> Rows:
    """Coordinates of the place themselves, from the ``first`` on."""
    knot, share, inside = _knots(grid, table.time)
    knot, share, seen = knot[inside], share[inside], table.values[inside]
    place = _between(x, at, robot, knot, share)
    before, after = at.place(robot, knot), at.place(robot, knot + 1)
    found = []
    for i in range(seen.shape[1]):
        axis = first + i
        jacobian = np.stack((1 - share, share), 1) / std
        columns = np.stack((before[:, axis], after[:, axis]), 1)
        found.append(Factor((place[:, axis] - seen[:, i]) / std, jacobian, columns))
    return found
