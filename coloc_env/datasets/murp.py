"""MURP (MIT ACL): three agents with six UWB antennas each, every antenna to every other's."""

import os
import re
from itertools import permutations
from pathlib import Path

import numpy as np

from coloc_env.datasets.files import FileFormat, Rows, distinct, fail, read
from coloc_env.datasets.folders import entries
from coloc_env.datasets.recording import (
    DataError,
    Flags,
    Floats,
    Recording,
    Table,
    Track,
    one_hemisphere,
    plausible,
)

SOURCE = (
    "MURP, MIT ACL; Fishberg, Quiter, How, RA-L 2024 (arXiv 2312.17731); "
    "open sourced for the robotics community, without a licence"
)
ANTENNAS = 6
_POSE = ("x", "y", "z", "roll", "pitch", "yaw")
_PAIRS = tuple((own, other) for own in range(ANTENNAS) for other in range(ANTENNAS))
_RANGES = tuple(f"{own + 1}_{other + 1}" for own, other in _PAIRS)
_FORMAT = FileFormat(
    (*(f"A_{name}" for name in _POSE), *(f"B_{name}" for name in _POSE), *_RANGES),
    "relative seconds",
    ",",
    header=True,
    stamp_column="t",
    optional=_RANGES,
)
_NAME = re.compile(r"(.+)_base-(\d+)_targ-(\d+)_win-1_step-1\.csv")
_REACH = 300.0  # m, of ultra-wideband ranging
_RADIUS = 0.32  # m, of the circle that the antennas are on


def load_murp(folder: str | os.PathLike[str]) -> Recording:
    """Load one trial: a file ``TRIAL_base-A_targ-B_win-1_step-1.csv`` for each ordered pair.

    A row is the mean over a window of 1 s, ranges and poses alike, one each second; its stamp is
    time since the trial's start. Agents are in the order of their numbers. An agent's pose stands
    in the files of all pairs that it is in, and must be the same in each. Lever arms are not in the
    files: those of NOTES.md, fitted to the true distances of its ranges, hold for all agents
    (antenna i at 0.32 m and 30 + 60 (i − 1) degrees in the body's xy plane). Stream: uav_ranges;
    the table of an agent holds what it measured as base, since A → B and B → A are two
    measurements. A field without a number (one in trial 16) is a range that was not measured. What
    is no range (not finite, not positive, beyond 300 m) is left out, such as the 5 zeros in trial
    14, where the antennas were within 0.22 m.

    Measured on trials 09, 14 and 16, range minus truth: agents 2 and 3 are -0.11 to -0.14 m off
    (median; robust deviation 0.07 m), agent 1 and either +0.03 to +0.12 m (0.09 to 0.14 m, at most
    8 m). From one second to the next agents turn by up to 87 degrees and move by up to 0.49 m; the
    true ranges in the files are those of the mean poses within 0.03 m. The relative poses in the
    files are not (they differ by up to 0.5 m and 1 degree), and are not used.

    Raises:
        DataError: a file is missing or damaged, or files differ in their stamps or in an agent's
            pose.
    """
    folder = Path(folder)
    agents = agents_in(folder)
    if len(agents) < 2:
        raise DataError(f"{folder}: no TRIAL_base-A_targ-B_win-1_step-1.csv of two agents")
    files = {pair: _file(folder, *pair) for pair in permutations(agents, 2)}
    rows = {pair: distinct(read(path, _FORMAT)) for pair, path in files.items()}
    first = next(iter(rows))
    poses: dict[int, Floats] = {}
    for (base, target), each in rows.items():
        path = files[base, target]
        if not np.array_equal(each.time, rows[first].time):
            raise DataError(f"{path}: its stamps are not those of {files[first].name}")
        for agent, pose in ((base, each.values[:, :6]), (target, each.values[:, 6:12])):
            apart = np.not_equal(poses.setdefault(agent, pose), pose)
            moved: Flags = np.logical_or.reduce(apart, axis=1)
            if moved.any():
                fail(path, _FORMAT, moved, f"agent {agent} is elsewhere than in another file")
    time = rows[first].time
    known = sum(int((~np.isnan(each.values[:, 12:])).sum()) for each in rows.values())
    tables = tuple(
        _ranges([(i, rows[base, other]) for i, other in enumerate(agents) if other != base])
        for base in agents
    )
    angle = np.deg2rad(30 + 60 * np.arange(ANTENNAS))
    arms = _RADIUS * np.stack((np.cos(angle), np.sin(angle), np.zeros(ANTENNAS)), -1)
    return Recording(
        name=f"murp/{folder.name}",
        dim=3,
        robots=tuple(f"agent{agent}" for agent in agents),
        truth=tuple(
            Track(time, poses[agent][:, :3], _quaternions(poses[agent][:, 3:])) for agent in agents
        ),
        streams={"uav_ranges": tables},
        landmarks=np.empty((0, 3)),
        anchors=np.empty((0, 3)),
        tags=np.tile(arms, (len(agents), 1, 1)),
        source=SOURCE,
        dropped={"uav_ranges": known - sum(len(table.time) for table in tables)},
    )


def agents_in(folder: Path) -> tuple[int, ...]:
    """The numbers of the agents that a trial's files are of."""
    names = [_NAME.fullmatch(path.name) for path in entries(folder, "*.csv")]
    found = {int(number) for name in names if name for number in name.groups()[1:]}
    return tuple(sorted(found))


def _file(folder: Path, base: int, target: int) -> Path:
    return folder / f"{folder.name}_base-{base}_targ-{target}_win-1_step-1.csv"


def _ranges(measured: list[tuple[int, Rows]]) -> Table:
    """What one agent measured to each other robot, second by second."""
    time, values = [], []
    for robot, rows in measured:
        ranges = rows.values[:, 12:]
        step, pair = np.nonzero(plausible(ranges, _REACH))
        own, other = np.array(_PAIRS).T[:, pair]
        time.append(rows.time[step])
        who = np.full(len(step), robot)
        values.append(np.column_stack((own, who, other, ranges[step, pair])))
    order = np.argsort(np.concatenate(time), kind="stable")
    columns = ("own_tag", "robot", "tag", "range")
    return Table(np.concatenate(time)[order], np.concatenate(values)[order], columns)


def _quaternions(angles: Floats) -> Floats:
    """Roll, pitch and yaw (degrees; Rz Ry Rx) as quaternions [T, 4]."""
    half = 0.5 * np.deg2rad(angles)
    (cr, cp, cy), (sr, sp, sy) = np.cos(half).T, np.sin(half).T
    return one_hemisphere(
        np.stack(
            (
                cy * cp * cr + sy * sp * sr,
                cy * cp * sr - sy * sp * cr,
                cy * sp * cr + sy * cp * sr,
                sy * cp * cr - cy * sp * sr,
            ),
            -1,
        )
    )
