"""Small recordings in the open format, as people would make them, and a plain reader of them."""

import csv
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import yaml

Folder = dict[str, str]


def table(columns: str, rows: list[list[Any]], delimiter: str = ",") -> str:
    lines = [columns.replace(",", delimiter)]
    lines += [delimiter.join(map(str, row)) for row in rows]
    return "\n".join(lines) + "\n"


def wheeled() -> Folder:
    """Two robots in the plane: truth, wheels, sightings of landmarks and of each other."""
    rng = np.random.default_rng(1)
    files = {
        "recording.yaml": "dim: 2\nrobots: [ann, bob]\ntime: {unit: s, zero: relative}\n"
        "map:\n  landmarks:\n    door: [1.0, 2.5]\n    lamp: [-3, 0.25]\n"
    }
    for name, other in (("ann", "bob"), ("bob", "ann")):
        time = [f"{0.1 * i:.3f}" for i in range(30)]
        files[f"{name}/truth.csv"] = table(
            "stamp,x,y,heading", [[t, *rng.normal(size=2), 0.1] for t in time]
        )
        files[f"{name}/odometry.csv"] = table(
            "stamp,v,omega", [[t, *rng.normal(size=2)] for t in time]
        )
        files[f"{name}/sightings.csv"] = table(
            "stamp,landmark,robot,range,bearing",
            [
                [t, *(("door", "") if i % 2 else ("", other)), 1 + rng.uniform(), 0.3]
                for i, t in enumerate(time)
            ],
        )
    return files


def flying() -> Folder:
    """Two UAVs in space, stamps since 1970: IMU, ranges of two tags, height, fixes, points."""
    rng = np.random.default_rng(2)
    files = {
        "recording.yaml": "dim: 3\nrobots: [a, b]\ntime: {unit: ns, zero: epoch}\n"
        "tags: {a: [[0.1, 0, 0], [-0.1, 0, 0]], b: [[0, 0.1, 0], [0, -0.1, 0]]}\n"
        "map: {anchors: {north: [0, 5, 2], south: [0, -5, 2], up: [1, 1, 4]}}\n"
        "source: made\nlicence: none\n",
        "points.csv": table("stamp,robot,x,y,z", [[1700000000500000000, "a", 1, 2, 3]]),
    }
    for name, other in (("a", "b"), ("b", "a")):
        time = [1_700_000_000_000_000_000 + 50_000_000 * i for i in range(40)]
        files[f"{name}/imu.csv"] = table(
            "stamp,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z",
            [[t, *rng.normal(size=5), 9.8] for t in time],
        )
        files[f"{name}/ranges.csv"] = table(
            "stamp,to,own_tag,to_tag,range",
            [
                [t + 1, *(("north", 1, 0) if i % 3 else (other, 0, 1)), 2 + rng.uniform()]
                for i, t in enumerate(time)
            ],
        )
        files[f"{name}/height.csv"] = table("stamp,height", [[t, rng.normal()] for t in time])
        files[f"{name}/position_fix.csv"] = table(
            "stamp,x,y,z", [[t, *rng.normal(size=3)] for t in time[::5]]
        )
    return files


def swarm() -> Folder:
    """Two UAVs that listen to anchors, see each other's direction and the floor."""
    rng = np.random.default_rng(4)
    files = {
        "recording.yaml": "dim: 3\nrobots: [a, b]\ntime: {unit: s}\n"
        "map: {anchors: {north: [0, 5, 2], south: [0, -5, 2], up: [1, 1, 4]}}\n",
    }
    ends = ("north", "south", "up")
    for name, other in (("a", "b"), ("b", "a")):
        time = [f"{0.05 * i:.3f}" for i in range(40)]
        files[f"{name}/truth.csv"] = table(
            "stamp,x,y,z", [[t, *rng.normal(size=2), 1.5] for t in time]
        )
        files[f"{name}/tdoa.csv"] = table(
            "stamp,from,to,difference",
            [[t, ends[i % 3], ends[(i + 1) % 3], rng.normal()] for i, t in enumerate(time)],
        )
        files[f"{name}/angles.csv"] = table(
            "stamp,robot,azimuth,elevation",
            [[t, other, *rng.uniform(-1.5, 1.5, size=2)] for t in time],
        )
        files[f"{name}/flow.csv"] = table("stamp,vx,vy", [[t, *rng.normal(size=2)] for t in time])
    return files


def spreadsheet() -> Folder:
    """One tag, centimetres, milliseconds, semicolons, quotation marks, a TUM file."""
    rng = np.random.default_rng(3)
    time = [100 * i for i in range(25)]
    truth = [[0.1 * i, *rng.normal(size=3), 0, 0, 0, 1] for i in range(25)]
    return {
        "recording.yaml": "dim: 3\nunits: {length: cm}\ntime: {unit: ms}\n"
        "map: {anchors: {'A 1': [0, 0, 100], B: [500, 0, 120.5]}}\n",
        "tag/truth.tum": "# a comment\n" + "\n".join(" ".join(map(str, row)) for row in truth),
        "tag/ranges.csv": table(
            "stamp,range,to,note",
            [
                [t, 300 + 10 * rng.uniform(), '"A 1"' if i % 2 else "B", "x"]
                for i, t in enumerate(time)
            ],
            ";",
        ),
    }


FOLDERS = {"wheeled": wheeled, "flying": flying, "swarm": swarm, "spreadsheet": spreadsheet}


def write(home: Path, files: Folder) -> Path:
    for name, text in files.items():
        path = home / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text.encode("utf-8", "surrogateescape"))
    return home


def plainly(home: Path) -> dict[str, tuple[int, float]]:
    """By file: how many rows, and the sum of all its numbers in our units (ranges that none can
    have measured aside); read with nothing but csv and Decimal."""
    about = yaml.safe_load((home / "recording.yaml").read_text("utf-8-sig")) or {}
    scale = {"m": 1.0, "cm": 0.01, "mm": 0.001}[(about.get("units") or {}).get("length", "m")]
    found = {}
    for path in sorted(home.glob("*/*")):
        text = path.read_bytes().decode("utf-8-sig", "replace")
        lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        if path.suffix == ".tum":
            rows = [line.split("#")[0].split() for line in lines]
            numbers = [[float(cell) for cell in row[1:4]] for row in rows if row]
            found[f"{path.parent.name}/{path.stem}"] = (
                len(numbers),
                scale * sum(map(sum, numbers)),
            )
            continue
        delimiter = max(",;\t", key=lambda mark: lines[0].count(mark))
        header = [name.strip().lower().strip('"') for name in lines[0].lstrip("#").split(delimiter)]
        reader = csv.reader(lines[1:], delimiter=delimiter)
        rows = [row for row in reader if any(cell.strip(" ") for cell in row) and row[0][:1] != "#"]
        count, total = 0, 0.0
        for row in rows:
            cells = dict(zip(header, row, strict=True))
            Decimal(cells["stamp"])
            values = {
                name: float(cell) if cell.strip() else float("nan")
                for name, cell in cells.items()
                if name in NUMBERS[path.stem]
            }
            if "range" in values and not 0 < values["range"] * scale <= 1000:
                continue
            if "difference" in values and not abs(values["difference"] * scale) <= 1000:
                continue
            if not all(np.isfinite(value) and abs(value) <= 1e9 for value in values.values()):
                continue
            count += 1
            total += sum(v * (scale if n in LENGTHS else 1.0) for n, v in values.items())
        if count:
            found[f"{path.parent.name}/{path.stem}"] = (count, total)
    return found


LENGTHS = ("x", "y", "z", "range", "height", "v", "difference", "vx", "vy")
NUMBERS = {
    "truth": ("x", "y", "z"),
    "odometry": ("v", "omega"),
    "sightings": ("range",),
    "imu": ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"),
    "ranges": ("range", "own_tag"),
    "tdoa": ("difference",),
    "angles": ("azimuth", "elevation"),
    "flow": ("vx", "vy"),
    "height": ("height",),
    "position_fix": ("x", "y", "z"),
}
