"""Writing any recording in the open format, so that it is read back to the bit."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from coloc_env.datasets.open_format.description import CORNERS, FILE
from coloc_env.datasets.open_format.magnetic_map import FILE as MAGNETIC_MAP
from coloc_env.datasets.open_format.magnetic_map import write_magnetic_map
from coloc_env.datasets.open_format.reader import POINTS
from coloc_env.datasets.open_format.streams import stream_files
from coloc_env.datasets.open_format.truth import AXES, GROUPS, QUATERNION
from coloc_env.datasets.recording import DataError, Recording, Stamps, Table, Track
from coloc_env.staging import staged_folder

Column = Sequence[Any]
_SHOWN = {"own_tag", "tag"}  # columns of whole numbers


def write_recording(recording: Recording, out: str | os.PathLike[str]) -> None:
    """Write a folder that ``read_recording`` reads back the same, to the bit of each float64.

    Times are ns relative to the recording's zero; positions are about its ``origin``.

    Raises:
        ValueError: the folder cannot be written, or holds something else.
        DataError: a robot's name cannot be that of a folder.
    """
    for name in recording.robots:
        if "/" in name or "\\" in name or name.startswith("."):
            raise DataError(f"{name!r} cannot be the name of a folder")
    names = (*recording.robots, f"{POINTS}.csv", MAGNETIC_MAP, FILE)
    with staged_folder(Path(out), names) as folder:
        for i, robot in enumerate(recording.robots):
            home = folder / robot
            home.mkdir()
            if len(recording.truth[i].time):
                _write(home / "truth.csv", recording.truth[i].time, _truth(recording.truth[i]))
            for file, streams in stream_files(recording).items():
                tables = {name: recording.streams[name][i] for name in streams}
                time, columns = _merged(recording, tables)
                if len(time):
                    _write(home / f"{file}.csv", time, columns)
        if recording.magnetic_map is not None:
            write_magnetic_map(folder / MAGNETIC_MAP, recording.magnetic_map)
        if recording.points:
            _write_points(recording, folder / f"{POINTS}.csv")
        text = yaml.safe_dump(_description(recording), sort_keys=False, allow_unicode=True)
        (folder / FILE).write_text(text, encoding="utf-8")


def _description(recording: Recording) -> dict[str, Any]:
    about: dict[str, Any] = {
        "name": recording.name,
        "dim": recording.dim,
        "robots": list(recording.robots),
        "frame": "enu",
        "time": {"unit": "ns", "zero": recording.epoch or "relative"},
        "exchanges": "listed",
        "streams": list(recording.streams),
    }
    places = {
        "landmarks": dict(zip(recording.landmark_names, recording.landmarks.tolist(), strict=True)),
        "anchors": dict(zip(recording.anchor_names, recording.anchors.tolist(), strict=True)),
    }
    places |= {
        kind: {name: place.tolist() for name, place in found.items()}
        for kind, found in recording.places.items()
    }
    walls = {
        name: dict(zip(CORNERS, ends.tolist(), strict=True))
        for name, ends in recording.walls.items()
    }
    about["map"] = {kind: found for kind, found in (places | {"walls": walls}).items() if found}
    if recording.tags.shape[1]:
        about["tags"] = {
            robot: arms[~np.isnan(arms).any(1)].tolist()
            for robot, arms in zip(recording.robots, recording.tags, strict=True)
        }
    if recording.source:
        about["source"] = recording.source
    if recording.origin:
        about["origin"] = list(recording.origin)
    if recording.dropped:
        about["dropped"] = dict(recording.dropped)
    if len(recording.start):
        about["start"] = _start(recording)
    return about


def _start(recording: Recording) -> dict[str, Any]:
    found = {}
    for robot, row in zip(recording.robots, recording.start, strict=True):
        place, turned = row[: recording.dim], row[recording.dim :]
        own: dict[str, Any] = {}
        if not np.isnan(place).any():
            own["position"] = place.tolist()
        if not np.isnan(turned).any():
            flat = recording.dim == 2
            own["heading" if flat else "quaternion"] = (
                float(turned[0]) if flat else np.roll(turned, -1).tolist()
            )
        if own:
            found[robot] = own
    return found


def _truth(track: Track) -> dict[str, Column]:
    dim = track.position.shape[1]
    columns: dict[str, Column] = dict(zip(AXES, track.position.T.tolist(), strict=False))
    if dim == 2:
        columns["heading"] = track.attitude[:, 0].tolist()
    else:
        columns |= zip(QUATERNION, np.roll(track.attitude, -1, 1).T.tolist(), strict=True)
    for name, titles in GROUPS.items():
        values = getattr(track, name)
        if values is not None:
            columns |= zip(titles, values.T.tolist(), strict=False)
    return columns


def _merged(recording: Recording, tables: dict[str, Table]) -> tuple[Stamps, dict[str, Column]]:
    """One robot's streams of one file, in the order of time: the rows of each in their order."""
    parts = [_columns(recording, name, table) for name, table in tables.items()]
    time = np.concatenate([table.time for table in tables.values()])
    order = np.argsort(time, kind="stable")
    titles = dict.fromkeys(title for part in parts for title in part)
    merged: dict[str, Column] = {}
    for title in titles:
        cells: list[Any] = []
        for part, table in zip(parts, tables.values(), strict=True):
            cells += part.get(title, [""] * len(table.time))
        merged[title] = [cells[i] for i in order]
    return time[order], merged


def _columns(recording: Recording, stream: str, table: Table) -> dict[str, Column]:
    """The columns of a stream as the format names them."""
    found: dict[str, Column] = {}
    for name, values in zip(table.columns, table.values.T, strict=True):
        if name == "anchor":
            found["to"] = _named(recording.anchor_names, values)
        elif name == "robot":
            title = "to" if stream in ("uav_ranges", "uav_rssi") else "robot"
            found[title] = _named(recording.robots, values)
        elif name in ("from", "to"):
            found[name] = _named(recording.anchor_names, values)
        elif name in ("point", "lamp"):
            title, kind = ("to", "access_points") if name == "point" else ("lamp", "lamps")
            found[title] = _named(tuple(recording.places[kind]), values)
        elif name == "landmark":
            found["landmark"] = _named(recording.landmark_names, values)
        elif name in _SHOWN:
            title = "to_tag" if name == "tag" else name
            found[title] = values.astype(np.int64).tolist()
        else:
            title = "wz" if name == "omega" and "vx" in table.columns else name
            found[title] = values.tolist()
    if stream == "anchor_ranges":
        found["to_tag"] = [0] * len(table.time)
    return found


def _named(names: tuple[str, ...], index: np.ndarray) -> list[str]:
    return [names[int(i)] for i in index]


def _write_points(recording: Recording, path: Path) -> None:
    time = np.concatenate([table.time for table in recording.points])
    order = np.argsort(time, kind="stable")
    places = np.concatenate([table.values for table in recording.points])[order]
    counts = [len(table.time) for table in recording.points]
    owner = np.repeat(np.arange(len(counts)), counts)[order]
    columns: dict[str, Column] = {"robot": _named(recording.robots, owner)}
    _write(path, time[order], columns | dict(zip(AXES, places.T.tolist(), strict=False)))


def _write(path: Path, time: Stamps, columns: dict[str, Column]) -> None:
    """A CSV file: numbers in the fewest digits that are read back as the same float64."""
    texts = [map(str, time.tolist())]
    texts += [map(_cell, cells) for cells in columns.values()]
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join(("stamp", *columns)) + "\n")
        file.writelines(",".join(row) + "\n" for row in zip(*texts, strict=True))


def _cell(value: Any) -> str:
    text = repr(value) if isinstance(value, float) else str(value)
    return '"' + text.replace('"', '""') + '"' if set(text) & set(',"\n') else text
