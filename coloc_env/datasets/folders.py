"""Where recordings lie, and what there is in their folders."""

import os
import re
from collections.abc import Iterator
from pathlib import Path

from coloc_env.datasets.recording import DataError

HOMES = {
    "mrclam": "http://asrl.utias.utoronto.ca/datasets/mrclam/",
    "euroc": "https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets",
    "miluv": "https://github.com/decargroup/miluv",
    "tuc": "https://github.com/TUC-ProAut/libRSF",
    "hanyang": "https://doi.org/10.5281/zenodo.15226105",
    "tiers": "https://github.com/TIERS/uwb-cooperative-mrs-localization",
    "murp": "https://github.com/mit-acl/murp-datasets",
}
_FOLDERS = {  # where not the name
    "tuc": "tuc_indoor_uwb",
    "hanyang": "hanyang_outdoor_uwb",
    "tiers": "tiers_mrs",
    "murp": "murp/parsed",
}
_READ = (
    ".csv",
    ".dat",
    ".npz",
    ".parquet",
    ".tum",
    ".txt",
    ".yaml",
)  # suffixes of files that loaders read
Version = tuple[tuple[str, int, int], ...]


def data_root(data: str | os.PathLike[str] | None = None) -> Path:
    """The folder that holds one folder per dataset.

    Args:
        data: the folder; by default the environment variable COLOC_DATA, else ``../shared/data``
            from the root of a checkout of the project.

    Raises:
        DataError: there is no such folder.
    """
    chosen = data or os.environ.get("COLOC_DATA")
    checkout = Path(__file__).resolve().parents[2]
    if chosen:
        root = expanded(chosen)
    elif (checkout / "pyproject.toml").is_file():
        root = checkout.parent / "shared" / "data"
    else:
        raise DataError(f"no folder of recordings is known: {_remedy(*HOMES)}")
    if not root.is_dir():
        raise DataError(f"no folder of recordings {root}: {_remedy(*HOMES)}")
    return root


def dataset_folder(name: str, data: str | os.PathLike[str] | None = None) -> Path:
    """The folder of dataset ``name`` in :func:`data_root`.

    Raises:
        DataError: there is no such folder.
    """
    folder = data_root(data) / _FOLDERS.get(name, name)
    if not folder.is_dir():
        raise DataError(f"no recordings in {folder}: {_remedy(name)}")
    return folder


def version(folder: Path) -> Version:
    """Path, size and modification time (ns) of every file below that a loader may read: another
    version has other recordings."""
    found = []
    for path, folders, names in os.walk(folder.resolve(), followlinks=True):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in names:
            if name.endswith(_READ):
                file = os.path.join(path, name)
                try:
                    status = os.stat(file)
                except OSError:  # a dangling link
                    continue
                found.append((file, status.st_size, status.st_mtime_ns))
    return tuple(sorted(found))


def entries(folder: Path, pattern: str = "*") -> Iterator[Path]:
    """What in a folder fits ``pattern``, in natural order, without what systems hide there
    (``.DS_Store``, ``._name``)."""
    names = [path.relative_to(folder).as_posix() for path in folder.glob(pattern)]
    shown = [name for name in names if not any(part[0] == "." for part in name.split("/"))]
    yield from (folder / name for name in sorted(shown, key=natural))


def natural(name: str) -> tuple[tuple[int, int, str], ...]:
    """A key that sorts names as people count: ``robot2`` before ``robot12``."""
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts)


def expanded(path: str | os.PathLike[str]) -> Path:
    """The path with ``~`` replaced by the user's home; DataError where there is none."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise DataError(f"{path}: no home folder is known; set HOME or give a whole path") from None


def _remedy(*names: str) -> str:
    homes = ", ".join(f"{_FOLDERS.get(name, name)}/ (from {HOMES[name]})" for name in names)
    return f"set COLOC_DATA or --data to the folder that holds {homes}"
