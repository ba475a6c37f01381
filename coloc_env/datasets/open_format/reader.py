"""The open recording format: a folder with ``recording.yaml`` and a folder of tables a robot."""

import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from coloc_env.datasets.folders import entries, expanded
from coloc_env.datasets.open_format import streams
from coloc_env.datasets.open_format.columns import Columns, Kind, read_columns
from coloc_env.datasets.open_format.description import FILE, Description, read_description
from coloc_env.datasets.open_format.frames import world
from coloc_env.datasets.open_format.magnetic_map import FILE as MAGNETIC_MAP
from coloc_env.datasets.open_format.magnetic_map import read_magnetic_map
from coloc_env.datasets.open_format.truth import marked_points, read_truth
from coloc_env.datasets.recording import (
    DataError,
    MagneticMap,
    Recording,
    Stamps,
    Table,
    Track,
    near_origin,
)
from coloc_env.options import unknown

TABLES = (".csv", ".parquet")
TRUTHS = (*TABLES, ".tum", ".txt")
POINTS = "points"
KNOWN = ("truth", *streams.FILES)
Read = Callable[[Path, Mapping[str, Kind]], Columns]


def read_recording(folder: str | os.PathLike[str]) -> Recording:
    """Load a recording of one's own: a folder with ``recording.yaml`` and, for each robot, a folder
    of tables (``docs/reference/recording-format.md``). All of it but the robots is optional.

    Frames and units become ours, times ns since the earliest stamp where they counted from 1970. A
    measurement that its sensor cannot have made is left out and counted in ``dropped``. Columns
    that are not used are named in a warning. Coordinates far from their origin are moved near it
    (``near_origin``).

    Raises:
        DataError: a file is missing, damaged, or says what cannot be; one line with file, line,
            column and value.
    """
    folder = expanded(folder)
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder")
    if not (folder / FILE).is_file():
        raise DataError(f"{folder}: there is no {FILE}")
    about = read_description(folder / FILE)
    _require_known(folder, about)

    def read(path: Path, known: Mapping[str, Kind]) -> Columns:
        found = read_columns(path, known, about.unit)
        if found.unused:
            warnings.warn(f"{path}: not used: column {', '.join(found.unused)}", stacklevel=3)
        return found

    truth = tuple(_track(folder / robot, about, read) for robot in about.robots)
    found, dropped = streams.read_streams(folder, about, read, _only)
    points = marked_points(_only(folder, POINTS, TABLES), about, read)
    recording = replace(
        described(about, found),
        truth=truth,
        dropped={
            name: about.dropped.get(name, 0) + dropped.get(name, 0)
            for name in (*about.dropped, *(key for key in dropped if key not in about.dropped))
        },
        points=points,
    )
    if not any(len(time) for time in _times(recording)):
        raise DataError(f"{folder}: no file holds a sample")
    return near_origin(_from_earliest(recording) if about.epoch else recording)


def described(about: Description, found: Mapping[str, tuple[Table, ...]]) -> Recording:
    """A recording without truth, of what its description says and some streams."""
    anchors, landmarks = (
        np.array(list(places.values())).reshape(-1, about.dim)
        for places in (about.anchors, about.landmarks)
    )
    return Recording(
        name=about.name,
        dim=about.dim,
        robots=about.robots,
        truth=tuple(Track.unknown(about.dim) for _ in about.robots),
        streams=found,
        landmarks=world(landmarks, about.frame),
        anchors=world(anchors, about.frame),
        tags=streams.in_body(about.tags, about.frame),
        source=about.source,
        origin=about.origin,
        landmark_names=tuple(about.landmarks),
        anchor_names=tuple(about.anchors),
        epoch=about.zero,
        start=streams.start_in_world(about),
        places=streams.places_in_world(about),
        walls=streams.walls_in_world(about),
        magnetic_map=_magnetic_map(about),
    )


def _magnetic_map(about: Description) -> MagneticMap | None:
    path = about.file.path.parent / MAGNETIC_MAP
    if about.dim == 2 and path.is_file():
        raise DataError(f"{path}: a map of the field is for 3 dimensions")
    return read_magnetic_map(path, about.frame, about.length)


def _track(home: Path, about: Description, read: Read) -> Track:
    path = _only(home, "truth", TRUTHS)
    return Track.unknown(about.dim) if path is None else read_truth(path, about, read)


def _only(home: Path, stem: str, suffixes: tuple[str, ...] = TABLES) -> Path | None:
    """The one file of a name, whatever its suffix; None if there is none."""
    found = [
        home / f"{stem}{suffix}" for suffix in suffixes if (home / f"{stem}{suffix}").is_file()
    ]
    if len(found) > 1:
        raise DataError(f"{home}: {found[0].name} and {found[1].name} say the same")
    return found[0] if found else None


def _require_known(folder: Path, about: Description) -> None:
    """Refuse tables that would be ignored in silence: misspelt, or of a robot that is not named."""
    for path in entries(folder):
        if path.is_dir() and path.name not in about.robots:
            if any(each.suffix in TRUTHS for each in entries(path)):
                about.file.fail(("robots",), f"does not name {path.name}, which has tables")
        elif (
            path.is_file()
            and path.suffix in TABLES
            and path.name != MAGNETIC_MAP
            and path.stem != POINTS
        ):
            known = (POINTS, MAGNETIC_MAP.removesuffix(".csv"))
            raise DataError(f"{path}: {unknown('table', path.stem, known)}")
    for robot in about.robots:
        if not (folder / robot).is_dir():
            about.file.fail(("robots",), f"names {robot!r}, but there is no folder of that name")
        for path in entries(folder / robot):
            if path.suffix in TABLES and path.stem not in KNOWN:
                raise DataError(f"{path}: {unknown('table', path.stem, KNOWN)}")


def _times(recording: Recording) -> list[Stamps]:
    """The times of everything, truth and points included."""
    tables = [table for team in recording.streams.values() for table in team]
    return [each.time for each in (*tables, *recording.points)] + [
        track.time for track in recording.truth
    ]


def _from_earliest(recording: Recording) -> Recording:
    """Times since the earliest stamp, which ``epoch`` says."""
    zero = min(int(time[0]) for time in _times(recording) if len(time))

    def shift(table: Table) -> Table:
        return replace(table, time=table.time - zero)

    return replace(
        recording,
        truth=tuple(replace(track, time=track.time - zero) for track in recording.truth),
        streams={name: tuple(map(shift, team)) for name, team in recording.streams.items()},
        points=tuple(map(shift, recording.points)),
        epoch=zero,
    )
