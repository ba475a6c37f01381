"""Where recordings lie, and reading their text files: fast, checked, and cached on disk."""

import contextlib
import csv
import hashlib
import os
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Literal, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from coloc_env.datasets.recording import Flags, Floats, Stamps

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
_CACHE_VERSION = 1


class DataError(ValueError):
    """Recorded data that are missing or not what they should be; one line that names where."""


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
        root = Path(chosen).expanduser()
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


def _remedy(*names: str) -> str:
    homes = ", ".join(f"{_FOLDERS.get(name, name)}/ (from {HOMES[name]})" for name in names)
    return f"set COLOC_DATA or --data to the folder that holds {homes}"


@dataclass(frozen=True)
class FileFormat:
    """The columns of a kind of text file.

    Attributes:
        columns: names of the numeric columns wanted, the stamp not among them. Without
            ``header`` they are all that the file has, in this order, after the stamp.
        stamp: how times are written: decimal seconds since 1970, whole nanoseconds since 1970
            (also as 1.7e+18), seconds since a zero of the recording; None for a file without times.
        delimiter: None for white space.
        header: the first line names the columns, and others may stand among those wanted; the
            stamp is ``stamp_column``. Otherwise ``#`` starts a comment.
        whole: those of ``columns`` that hold whole numbers.
        stamp_column: the stamp's name in a header.
        optional: those of ``columns`` that may be empty, which reads as NaN; only with ``header``.
        words: every line begins with one of these words, and those with the first are the rows;
            none: all lines are rows, and begin with their stamp.
    """

    columns: tuple[str, ...]
    stamp: Literal["seconds", "nanoseconds", "relative seconds"] | None
    delimiter: str | None = None
    header: bool = False
    whole: tuple[str, ...] = ()
    stamp_column: str = "timestamp"
    words: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The wanted columns, the stamp first."""
        return ((self.stamp_column,) if self.stamp else ()) + self.columns


class Rows(NamedTuple):
    """A parsed file: time [T] int64 ns, never decreasing (zeros without stamps); values [T, F]."""

    time: Stamps
    values: Floats


def read(path: Path, form: FileFormat) -> Rows:
    """Parse a text file, or take what an earlier call parsed from the cache.

    The cache holds one ``.npz`` per file and format, in the folder COLOC_CACHE or else ``coloc``
    in the user's cache folder; it is renewed when the file's size or modification time change.

    Raises:
        DataError: the file is missing, empty, truncated, of another kind, holds something that
            is no finite number, or its times decrease; with its name and the line.
    """
    try:
        status = path.stat()
    except OSError:
        raise DataError(f"{path}: no such file") from None
    version = np.array([status.st_size, status.st_mtime_ns, _CACHE_VERSION])
    entry = _cache_folder() / f"{_digest(f'{path.resolve()} {form}')}.npz"
    rows = _cached(entry, version, len(form.columns))
    if rows is None:
        rows = _parse(path, form)
        _store(entry, version, rows)
    return rows


def distinct(rows: Rows) -> Rows:
    """Of samples that share a stamp, the first."""
    time, first = np.unique(rows.time, return_index=True)
    return Rows(time, rows.values[first])


def fail(path: Path, form: FileFormat, bad: Flags, reason: str) -> NoReturn:
    """Raise a DataError that names the line of the first data row that is ``bad``."""
    line, _ = next(islice(_lines(path, form), int(bad.argmax()), None))
    raise DataError(f"{path}, line {line}: {reason}")


def _parse(path: Path, form: FileFormat) -> Rows:
    try:
        table = _load(path, form)
    except DataError:
        raise
    except ValueError as error:
        _explain(path, form, error)
    if not len(table):
        raise DataError(f"{path}: no data")
    for name in form.columns:
        column = table[name]
        finite = np.isfinite(column)
        if name in form.optional:
            finite |= np.isnan(column)
        if not finite.all():
            fail(path, form, ~finite, f"{name} is not a finite number")
        if name in form.whole and (broken := column != np.rint(column)).any():
            fail(path, form, broken, f"{name} is {column[broken][0]:g}, not a whole number")
    time = _time(path, form, table)
    if (back := np.diff(time, prepend=time[0]) < 0).any():
        fail(path, form, back, "the time is before that of the line above")
    return Rows(time, np.stack([table[name] for name in form.columns], -1))


def _load(path: Path, form: FileFormat) -> NDArray[np.void]:
    """Every column of the file, those not wanted cut to a byte, so that all rows are checked."""
    kinds = dict.fromkeys(form.columns, "f8")
    kinds[form.stamp_column] = "f8" if form.stamp == "relative seconds" else "S32"
    names = _names(path, form)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*contained no data", UserWarning)
        return np.loadtxt(
            list(_marked(path, form)) if form.words else path,
            dtype=[(name or f"column {i}", kinds.get(name, "S1")) for i, name in enumerate(names)],
            converters={i: _optional for i, name in enumerate(names) if name in form.optional},
            comments=None if form.header else "#",
            delimiter=form.delimiter,
            skiprows=int(form.header),
            quotechar='"' if form.header else None,
            encoding="utf-8",
            ndmin=1,
        )


def _optional(field: str) -> float:
    return float(field) if field else np.nan


def _marked(path: Path, form: FileFormat) -> Iterator[str]:
    """The lines that begin with the format's first word."""
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            word = next(iter(line.split("#")[0].split()), None)
            if word is not None and word not in form.words:
                known = " or ".join(form.words)
                raise DataError(f"{path}, line {number}: begins with {word[:40]!r}, not {known}")
            if word == form.words[0]:
                yield line


def _names(path: Path, form: FileFormat) -> list[str]:
    """A name for each column of the file, empty or not among those wanted where it is not read."""
    if form.header:
        return _header(path, form)
    return [""] * bool(form.words) + list(form.names)


def _header(path: Path, form: FileFormat) -> list[str]:
    with path.open(encoding="utf-8", errors="replace") as file:
        names = next(csv.reader(file), None)
    if names is None:
        raise DataError(f"{path}: no data")
    for name in form.names:
        if names.count(name) != 1:
            raise DataError(f"{path}, line 1: the header does not name one column {name!r}")
    return names


def _time(path: Path, form: FileFormat, table: NDArray[np.void]) -> Stamps:
    """Nanoseconds; stamps since 1970 from their decimal text, since a float would round them."""
    if form.stamp is None:
        return np.zeros(len(table), np.int64)
    stamp = table[form.stamp_column]
    if form.stamp == "relative seconds":
        bad = ~(np.abs(stamp) < 9e6)  # beyond, a float is not exact to the nanosecond
        if bad.any():
            fail(path, form, bad, f"the time is {stamp[bad][0]:g}, not {form.stamp}")
        return np.rint(1e9 * stamp).astype(np.int64)
    plain, power, rest = np.strings.partition(stamp, np.bytes_(b"e+18"))
    digits, point, fraction = np.strings.partition(plain, np.bytes_(b"."))
    powered = np.strings.str_len(power) > 0
    bad = np.strings.str_len(rest) > 0
    if form.stamp == "seconds":
        bad |= powered | (np.strings.str_len(fraction) > 9)
        digits = np.strings.add(digits, np.strings.ljust(fraction, 9, np.bytes_(b"0")))
    else:
        bad |= (np.strings.str_len(point) > 0) & ~powered
        bad |= (np.strings.str_len(digits) > 1) & powered
        decimals = np.strings.ljust(fraction, 18, np.bytes_(b"0"))
        digits = np.where(powered, np.strings.add(digits, decimals), digits)
    length = np.strings.str_len(digits)
    bad |= ~np.strings.isdigit(digits) | (length > 19) | ((length == 19) & (digits >= b"9"))
    if bad.any():
        shown = stamp[bad][0].decode(errors="replace")
        fail(path, form, bad, f"the time is {shown}, not {form.stamp} since 1970")
    return digits.astype(np.int64)


def _lines(path: Path, form: FileFormat) -> Iterator[tuple[int, list[str]]]:
    """Line number and fields of every data row, the slow way."""
    with path.open(encoding="utf-8", errors="replace") as file:
        if form.header:
            reader = csv.reader(file)
            next(reader)
            yield from ((reader.line_num, fields) for fields in reader if fields)
        else:
            for number, line in enumerate(file, 1):
                if content := line.split("#")[0].strip():
                    fields = content.split(form.delimiter)
                    if not form.words or fields[0] == form.words[0]:
                        yield number, fields


def _explain(path: Path, form: FileFormat, error: ValueError) -> NoReturn:
    """Find the line that numpy could not parse."""
    names = _names(path, form)
    with contextlib.suppress(csv.Error):
        for line, fields in _lines(path, form):
            where = f"{path}, line {line}"
            if len(fields) != len(names):
                raise DataError(f"{where}: {len(fields)} columns, not {len(names)}") from None
            for name, field in zip(names, fields, strict=True):
                empty = not field and name in form.optional
                if name in form.columns and not empty and not _is_number(field):
                    raise DataError(f"{where}: {name} is {field[:40]!r}, not a number") from None
    raise DataError(f"{path}: cannot be parsed: {' '.join(str(error).split())}") from None


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _cache_folder() -> Path:
    if folder := os.environ.get("COLOC_CACHE"):
        return Path(folder).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "coloc"


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _cached(entry: Path, version: Stamps, columns: int) -> Rows | None:
    """What the cache holds for this version of a file; None if nothing that can be used."""
    try:
        with entry.open("rb") as file, np.load(file, allow_pickle=False) as saved:
            if not np.array_equal(saved["version"], version):
                return None
            rows = Rows(saved["time"], saved["values"])
    except Exception:  # a damaged archive raises errors of many kinds
        return None
    sound = rows.time.dtype == np.int64 and rows.values.shape == (*rows.time.shape, columns)
    return rows if sound else None


def _store(entry: Path, version: Stamps, rows: Rows) -> None:
    """Write a cache entry whole or not at all; a folder that cannot be written is no error."""
    with contextlib.suppress(OSError):
        entry.parent.mkdir(parents=True, exist_ok=True)
        handle, scratch = tempfile.mkstemp(dir=entry.parent, suffix=".tmp")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(file, version=version, time=rows.time, values=rows.values)
            os.replace(scratch, entry)
        except BaseException:
            os.unlink(scratch)
            raise
