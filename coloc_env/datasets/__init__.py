"""Real recordings, read from the owners' files into one form."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from coloc_env.datasets import euroc, hanyang, miluv, mrclam, murp, tiers, tuc
from coloc_env.datasets.euroc import load_euroc
from coloc_env.datasets.folders import data_root, dataset_folder, entries
from coloc_env.datasets.hanyang import load_hanyang
from coloc_env.datasets.miluv import load_miluv
from coloc_env.datasets.mrclam import load_mrclam
from coloc_env.datasets.murp import load_murp
from coloc_env.datasets.recording import DataError, Recording, Table, Track, near_origin
from coloc_env.datasets.tiers import load_tiers
from coloc_env.datasets.tuc import load_tuc

__all__ = [
    "DATASETS",
    "DataError",
    "Recording",
    "Table",
    "Track",
    "data_root",
    "load",
    "load_euroc",
    "load_hanyang",
    "load_miluv",
    "load_mrclam",
    "load_murp",
    "load_tiers",
    "load_tuc",
    "sequences",
]


@dataclass(frozen=True)
class _Dataset:
    """Its loader, and which sequences a folder holds: their names and numbers of robots."""

    load: Callable[..., Recording]
    sequences_in: Callable[[Path], dict[str, int]]


def _folders(robots_in: Callable[[Path], tuple[Any, ...]]) -> Callable[[Path], dict[str, int]]:
    """A folder per sequence, in which ``robots_in`` finds robots."""

    def sequences_in(home: Path) -> dict[str, int]:
        folders = [path for path in entries(home) if path.is_dir()]
        robots = {folder.name: len(robots_in(folder)) for folder in folders}
        return {name: count for name, count in robots.items() if count}

    return sequences_in


_DATASETS = {
    "mrclam": _Dataset(load_mrclam, _folders(mrclam.robots_in)),
    "euroc": _Dataset(load_euroc, _folders(euroc.robots_in)),
    "miluv": _Dataset(load_miluv, _folders(miluv.robots_in)),
    "tuc": _Dataset(load_tuc, tuc.sequences_in),
    "hanyang": _Dataset(load_hanyang, hanyang.sequences_in),
    "tiers": _Dataset(load_tiers, tiers.sequences_in),
    "murp": _Dataset(load_murp, _folders(murp.agents_in)),
}
DATASETS = tuple(_DATASETS)


def load(
    name: str,
    sequence: str | None = None,
    data: str | os.PathLike[str] | None = None,
    **options: Any,
) -> Recording:
    """Load a recording found in the data folder, about an origin of its own (``near_origin``).

    Args:
        name: one of DATASETS.
        sequence: one of :func:`sequences`; for euroc several, with commas between them, make a
            team. By default the sequence with the most robots, for euroc all of the room with the
            most sequences; the first by name among equals.
        data: the data folder, see :func:`data_root`.
        options: handed on to the dataset's loader.

    Raises:
        DataError: an unknown dataset or sequence, or files that are missing or damaged.
    """
    found = _found(name, data)
    folder = dataset_folder(name, data)
    wanted = sequence.split(",") if sequence else _largest(name, folder, found)
    for each in wanted:
        if each not in found:
            known = ", ".join(found) or "none"
            raise DataError(f"no sequence {each!r} in {folder}, there are: {known}")
    loader = _DATASETS[name].load
    if name == "euroc":
        return near_origin(loader([folder / each for each in wanted], **options))
    if len(wanted) != 1:
        raise DataError(f"{name} is loaded one sequence at a time, not {sequence}")
    return near_origin(loader(folder / wanted[0], **options))


def sequences(name: str, data: str | os.PathLike[str] | None = None) -> tuple[str, ...]:
    """The sequences of a dataset that are in the data folder, sorted.

    Raises:
        DataError: an unknown dataset, or no folder for it.
    """
    return tuple(_found(name, data))


def _found(name: str, data: str | os.PathLike[str] | None) -> dict[str, int]:
    """The sequences that are there, and the number of robots of each."""
    if name not in _DATASETS:
        raise DataError(f"no dataset {name!r}, there are: {', '.join(DATASETS)}")
    return _DATASETS[name].sequences_in(dataset_folder(name, data))


def _largest(name: str, folder: Path, found: dict[str, int]) -> list[str]:
    if not found:
        raise DataError(f"no sequence of {name} in {folder}")
    if name == "euroc":
        return max((list(team) for _, team in groupby(found, euroc.room)), key=len)
    return [max(found, key=lambda each: found[each])]
