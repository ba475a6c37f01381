"""Real recordings: MRCLAM, EuRoC and MILUV, read from the owners' files into one form."""

import os
from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import Any

from coloc_env.datasets import euroc, miluv, mrclam
from coloc_env.datasets.euroc import load_euroc
from coloc_env.datasets.files import DataError, data_root, dataset_folder
from coloc_env.datasets.miluv import load_miluv
from coloc_env.datasets.mrclam import load_mrclam
from coloc_env.datasets.recording import Recording, Table, Track

__all__ = [
    "DATASETS",
    "DataError",
    "Recording",
    "Table",
    "Track",
    "data_root",
    "load",
    "load_euroc",
    "load_miluv",
    "load_mrclam",
    "sequences",
]

_ROBOTS_IN: dict[str, Callable[[Path], tuple[str, ...]]] = {
    "mrclam": mrclam.robots_in,
    "euroc": euroc.robots_in,
    "miluv": miluv.robots_in,
}
DATASETS = tuple(_ROBOTS_IN)


def load(
    name: str,
    sequence: str | None = None,
    data: str | os.PathLike[str] | None = None,
    **options: Any,
) -> Recording:
    """Load a recording found in the data folder.

    Args:
        name: one of DATASETS.
        sequence: the sequence's folder; for euroc several, with commas between them, make a team.
            By default the sequence with the most robots, for euroc all of the room with the most
            sequences; the first by name among equals.
        data: the data folder, see :func:`data_root`.
        options: handed on to the dataset's loader.

    Raises:
        DataError: an unknown dataset or sequence, or files that are missing or damaged.
    """
    found = sequences(name, data)
    folder = dataset_folder(name, data)
    wanted = sequence.split(",") if sequence else _largest(name, folder, found)
    for each in wanted:
        if each not in found:
            known = ", ".join(found) or "none"
            raise DataError(f"no sequence {each!r} in {folder}, there are: {known}")
    if name == "euroc":
        return load_euroc([folder / each for each in wanted], **options)
    if len(wanted) != 1:
        raise DataError(f"{name} is loaded one sequence at a time, not {sequence}")
    loader = load_mrclam if name == "mrclam" else load_miluv
    return loader(folder / wanted[0], **options)


def sequences(name: str, data: str | os.PathLike[str] | None = None) -> tuple[str, ...]:
    """The sequences of a dataset that are in the data folder, sorted.

    Raises:
        DataError: an unknown dataset, or no folder for it.
    """
    if name not in _ROBOTS_IN:
        raise DataError(f"no dataset {name!r}, there are: {', '.join(DATASETS)}")
    folders = sorted(path for path in dataset_folder(name, data).iterdir() if path.is_dir())
    return tuple(folder.name for folder in folders if _ROBOTS_IN[name](folder))


def _largest(name: str, folder: Path, found: tuple[str, ...]) -> list[str]:
    if not found:
        raise DataError(f"no sequence of {name} in {folder}")
    if name == "euroc":
        return max((list(team) for _, team in groupby(found, euroc.room)), key=len)
    return [max(found, key=lambda each: len(_ROBOTS_IN[name](folder / each)))]
