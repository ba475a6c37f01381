"""A team's whole trajectory from all its measurements at once, where there is no truth.

Maximum a posteriori: positions at knots (and headings, where wheels turn), a bias of every link
of ranges; motion by odometry or of constant velocity; Huber's loss by reweighting,
Levenberg-Marquardt steps on sparse normal equations.
"""

from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from coloc_env.datasets.grid import Grid, odometry_on
from coloc_env.datasets.noise_model import NoiseModel
from coloc_env.datasets.open_format.truth import course
from coloc_env.datasets.recording import DataError, Floats, Recording, Track
from coloc_env.datasets.residuals import links_of
from training.calibration.smoother_factors import DT, Rows, Unknowns, factors

_HUBER = 1.345
_ROUNDS = 40
_STEPS = 4  # of a place, along its ranges
_LOOSE = 0.5  # m


def smoothed(recording: Recording, model: NoiseModel) -> Recording:
    """The recording with the team's smoothed estimate in the place of its truth.

    Needs anchors, landmarks or fixes in the map's frame. ``model`` says how noisy what is.

    Raises:
        DataError: nothing in the recording shows where anybody is.
    """
    fixed = {"anchor_ranges", "landmark_bearings", "position_fix"} & recording.streams.keys()
    if not fixed:
        raise DataError(f"{recording.name}: no anchor, landmark or fix shows where anybody is")
    times = [t.time for name in fixed for t in recording.streams[name] if len(t.time)]
    start, end = min(int(t[0]) for t in times), max(int(t[-1]) for t in times)
    grid = Grid(start, DT, int((end - start) * 1e-9 / DT) + 2)
    turning = recording.dim == 2 and "odometry" in recording.streams
    if "landmark_bearings" in recording.streams and not turning:
        raise DataError(f"{recording.name}: bearings need odometry to be smoothed without truth")
    names = [k.name for s in ("anchor_ranges", "uav_ranges") for k in links_of(recording, s)]
    at = Unknowns(recording, grid, names, turning)
    x = _solved(recording, model, grid, at, _initial(recording, grid, at))
    tracks = []
    for robot in range(at.robots):
        knots = np.arange(at.knots)
        places = x[at.place(robot, knots)]
        if turning:
            attitude = np.unwrap(x[at.heading(robot, knots)])[:, None]
        else:
            angle = course(grid.times, places)
            zero = np.zeros_like(angle)
            level = np.stack((np.cos(angle / 2), zero, zero, np.sin(angle / 2)), 1)
            attitude = angle[:, None] if recording.dim == 2 else level
        tracks.append(Track(grid.times, places, attitude))
    return replace(recording, truth=tuple(tracks))


def _solved(recording: Recording, model: NoiseModel, grid: Grid, at: Unknowns, x: Floats) -> Floats:
    """Levenberg-Marquardt from ``x`` on."""
    damping = 1e-2
    cost = _cost(factors(recording, model, grid, at, x))
    for _ in range(_ROUNDS):
        normal, gradient = _normal(factors(recording, model, grid, at, x), at.size)
        diagonal = sparse.diags(damping * normal.diagonal() + 1e-9)
        step = spsolve((normal + diagonal).tocsc(), gradient)
        tried = x - step
        after = _cost(factors(recording, model, grid, at, tried))
        if after < cost:
            done = cost - after < 1e-6 * cost
            x, cost, damping = tried, after, max(damping / 5, 1e-9)
            if done:
                break
        else:
            damping = damping * 10
            if damping > 1e6:
                break
    return x


def _cost(rows: Rows) -> float:
    """Huber's loss of robust residuals, squares of the others."""
    total = 0.0
    for each in rows:
        size = np.abs(each.residual)
        loss = size**2
        if each.robust:
            loss = np.where(size <= _HUBER, loss, 2 * _HUBER * size - _HUBER**2)
        total += float(loss.sum())
    return total


def _normal(found: Rows, size: int) -> tuple[sparse.csr_matrix, Floats]:
    """JᵀWJ and JᵀWr."""
    data, rows, columns, residual, done = [], [], [], [], 0
    for each in found:
        weight = np.ones(len(each.residual))
        if each.robust:
            weight = np.minimum(1.0, _HUBER / np.maximum(np.abs(each.residual), 1e-9))
        root = np.sqrt(weight)
        data.append((each.jacobian * root[:, None]).ravel())
        columns.append(each.columns.ravel())
        rows.append(np.repeat(done + np.arange(len(root)), each.columns.shape[1]))
        residual.append(each.residual * root)
        done += len(root)
    whole = (np.concatenate(data), (np.concatenate(rows), np.concatenate(columns)))
    jacobian = sparse.csr_matrix(whole, shape=(done, size))
    return jacobian.T @ jacobian, jacobian.T @ np.concatenate(residual)


def _initial(recording: Recording, grid: Grid, at: Unknowns) -> Floats:
    """Everybody from the start that is given, or from amid the map, along the anchor ranges;
    headings by odometry alone."""
    x = np.zeros(at.size)
    places = np.concatenate((recording.anchors, recording.landmarks))
    middle = places.mean(0) if len(places) else np.zeros(at.dim)
    knots = np.arange(at.knots)
    for robot in range(at.robots):
        place, heading = middle, 0.0
        if len(recording.start):
            own = recording.start[robot]
            place = np.where(np.isnan(own[: at.dim]), middle, own[: at.dim])
            heading = float(np.nan_to_num(own[at.dim])) if at.dim == 2 else 0.0
        x[at.place(robot, knots)] = _walked(recording, grid, robot, place)
        if at.turning:
            rate = odometry_on(grid, recording.streams["odometry"][robot])[:, 2]
            turned = np.cumsum(np.append(0.0, rate[1:])) * DT
            x[at.heading(robot, knots)] = heading + turned
    return x


def _walked(recording: Recording, grid: Grid, robot: int, place: Floats) -> Floats:
    """Places [K, d] knot by knot, each a few Gauss-Newton steps on its ranges to anchors from the
    one before."""
    found = np.tile(place, (grid.count, 1))
    if "anchor_ranges" not in recording.streams:
        return found
    table = recording.streams["anchor_ranges"][robot]
    ends = np.searchsorted(table.time, grid.times)
    for k in range(1, grid.count):
        now = table.values[ends[k - 1] : ends[k]]
        place = before = found[k - 1]
        for _ in range(_STEPS if len(now) else 0):
            apart = place - recording.anchors[now[:, 1].astype(np.int64)]
            distance = np.maximum(np.linalg.norm(apart, axis=1), 1e-3)
            off = distance - now[:, -1]
            weight = 1 / np.maximum(np.abs(off), _LOOSE)
            unit = apart / distance[:, None]
            normal = (unit * weight[:, None]).T @ unit + np.eye(len(place)) / _LOOSE
            gradient = (unit * weight[:, None]).T @ off + (place - before) / _LOOSE
            place = place - np.linalg.solve(normal, gradient)
        found[k] = place
    return found
