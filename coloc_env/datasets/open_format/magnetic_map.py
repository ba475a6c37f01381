"""``magnetic_map.csv``: the magnetic field at the nodes of a grid."""

import csv
import itertools
from pathlib import Path

import numpy as np

from coloc_env.datasets.open_format import frames
from coloc_env.datasets.open_format.columns import DELIMITERS
from coloc_env.datasets.open_format.truth import AXES
from coloc_env.datasets.recording import DataError, Floats, MagneticMap
from coloc_env.sensors.field_map import MOST

FILE = "magnetic_map.csv"
COLUMNS = (*AXES, "bx", "by", "bz")
_EVEN = 1e-6  # of a spacing, by which nodes may be off
_STRONGEST = 1.0  # T: twenty thousand times the Earth's


def read_magnetic_map(path: Path, frame: str, length: float) -> MagneticMap | None:
    """``x, y, z`` of each node and ``bx, by, bz`` (tesla) there, both in the world frame, in any
    order; None if there is no such file.

    Raises:
        DataError: a column or a number is missing, or the nodes are those of no even grid.
    """
    if not path.is_file():
        return None
    rows = _rows(path)
    places = frames.world(rows[:, :3] * length, frame)
    field = frames.world(rows[:, 3:], frame)
    axes, index = [], []
    for name, values in zip(AXES, places.T, strict=True):
        axis, at = np.unique(values, return_inverse=True)
        axes.append(axis)
        index.append(at)
        gaps = np.diff(axis)
        if len(gaps) and np.ptp(gaps) > _EVEN * gaps.mean():
            least, most = gaps.min(), gaps.max()
            raise DataError(
                f"{path}: nodes are {least:g} to {most:g} m apart in {name}, not evenly"
            )
    count = tuple(len(axis) for axis in axes)
    flat = np.ravel_multi_index(tuple(index), count)
    if len(rows) != np.prod(count) or len(np.unique(flat)) != len(rows):
        x, y, z = count
        raise DataError(
            f"{path}: {len(rows)} nodes, not each one of a grid of {x} × {y} × {z} once"
        )
    return MagneticMap((axes[0], axes[1], axes[2]), field[np.argsort(flat)].reshape(*count, 3))


def write_magnetic_map(path: Path, known: MagneticMap) -> None:
    """Read back the same, to the bit of each float64."""
    nodes = itertools.product(*(axis.tolist() for axis in known.axes))
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join(COLUMNS) + "\n")
        for place, field in zip(nodes, known.field.reshape(-1, 3).tolist(), strict=True):
            file.write(",".join(map(repr, (*place, *field))) + "\n")


def _rows(path: Path) -> Floats:
    """The numbers [F, 6] of the file's columns."""
    try:
        text = path.read_text(encoding="utf-8-sig").splitlines()
        mark = max(DELIMITERS, key=text[0].count) if text else ","
        lines = list(csv.reader(text, delimiter=mark))
    except (OSError, UnicodeDecodeError, csv.Error):
        raise DataError(f"{path}: not a CSV file of UTF-8 text") from None
    head = [name.strip().lower() for name in lines[0]] if lines else []
    for name in COLUMNS:
        if head.count(name) != 1:
            raise DataError(f"{path}, line 1: a column {name!r} is needed, once")
    if len(lines) - 1 > MOST:
        raise DataError(f"{path}: {len(lines) - 1} nodes, more than {MOST}")
    at = [head.index(name) for name in COLUMNS]
    rows = []
    for line, cells in enumerate(lines[1:], 2):
        if not any(cell.strip() for cell in cells) or cells[0].startswith("#"):
            continue
        try:
            row = [float(cells[i]) for i in at]
        except (ValueError, IndexError):
            row = [np.nan]
        if not np.isfinite(row).all():
            raise DataError(f"{path}, line {line}: six finite numbers are needed")
        if (strongest := max(map(abs, row[3:]))) > _STRONGEST:
            raise DataError(f"{path}, line {line}: a field of {strongest:g} T; tesla are needed")
        rows.append(row)
    if not rows:
        raise DataError(f"{path}: no node")
    return np.array(rows)
