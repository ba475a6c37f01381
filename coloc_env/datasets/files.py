"""Reading recordings' text files: fast, checked, and cached on disk."""

import contextlib
import csv
import decimal
import hashlib
import os
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Literal, NamedTuple, NoReturn, TextIO

import numpy as np
from numpy.typing import NDArray

from coloc_env.datasets.recording import DataError, Flags, Floats, Stamps

_CACHE_VERSION = 2
_MOST = 1e9  # of anything recorded, in any unit
_STAMP = 48  # characters of a stamp


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
        optional: those of ``columns`` in which a sample may be missing: empty (with a delimiter),
            which reads as NaN, or not finite; what is beyond all measure reads as infinity.
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


def read(path: Path, form: FileFormat, *, empty: bool = False) -> Rows:
    """Parse a text file, or take what an earlier call parsed from the cache.

    Marks of byte order, line ends of any system, blank lines and bytes that are not UTF-8 in what
    is not read are no fault. Stamps are rounded to the nanosecond. ``empty``: it may have no rows.

    The cache holds one ``.npz`` per file and format, in the folder COLOC_CACHE or else ``coloc``
    in the user's cache folder; it is renewed when the file's size or modification time change.

    Raises:
        DataError: the file is missing, empty, truncated, of another kind, holds something that is
            no number up to 1e9, or its times decrease; with its name and the line.
    """
    try:
        status = path.stat()
    except OSError:
        raise DataError(f"{path}: no such file") from None
    version = np.array([status.st_size, status.st_mtime_ns, _CACHE_VERSION])
    folder = _cache_folder()
    entry = None if folder is None else folder / f"{_digest(f'{path.resolve()} {form}')}.npz"
    rows = None if entry is None else _cached(entry, version, len(form.columns))
    if rows is None:
        rows = _parse(path, form)
        if entry is not None:
            _store(entry, version, rows)
    if not len(rows.time) and not empty:
        raise DataError(f"{path}: no data")
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
    for name in form.columns:
        column = table[name]
        sane = np.abs(column) <= _MOST
        if name in form.optional:
            column[np.abs(column) > _MOST] = np.inf
        elif (bad := ~np.isfinite(column)).any():
            fail(path, form, bad, f"{name} is not a finite number")
        elif not sane.all():
            fail(path, form, ~sane, f"{name} is {column[~sane][0]:g}, beyond {_MOST:g}")
        if name in form.whole and (broken := column != np.rint(column)).any():
            fail(path, form, broken, f"{name} is {column[broken][0]:g}, not a whole number")
    time = _time(path, form, table)
    if (back := np.diff(time, prepend=time[:1]) < 0).any():
        fail(path, form, back, "the time is before that of the line above")
    return Rows(time, np.stack([table[name] for name in form.columns], -1))


def _load(path: Path, form: FileFormat) -> NDArray[np.void]:
    """Every column of the file, those not wanted cut to a byte, so that all rows are checked."""
    kinds = dict.fromkeys(form.columns, "f8")
    kinds[form.stamp_column] = "f8" if form.stamp == "relative seconds" else f"S{_STAMP}"
    names = _names(path, form)
    may_be_empty = form.optional if form.delimiter else ()
    with warnings.catch_warnings(), _text(path) as file:
        warnings.filterwarnings("ignore", ".*contained no data", UserWarning)
        return np.loadtxt(
            list(_marked(path, form)) if form.words else file,
            dtype=[(name or f"column {i}", kinds.get(name, "S1")) for i, name in enumerate(names)],
            converters={i: _optional for i, name in enumerate(names) if name in may_be_empty},
            comments=None if form.header else "#",
            delimiter=form.delimiter,
            skiprows=int(form.header),
            quotechar='"' if form.header else None,
            ndmin=1,
        )


def _text(path: Path) -> TextIO:
    """The file as text without a mark of byte order; what is not UTF-8 is replaced."""
    return path.open(encoding="utf-8-sig", errors="replace")


def _optional(field: str) -> float:
    return float(field) if field.strip() else np.nan


def _marked(path: Path, form: FileFormat) -> Iterator[str]:
    """The lines that begin with the format's first word."""
    with _text(path) as file:
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
    with _text(path) as file:
        names = next(csv.reader(file), None)
    if names is None:
        raise DataError(f"{path}: no data")
    for name in form.names:
        if names.count(name) != 1:
            raise DataError(f"{path}, line 1: the header does not name one column {name!r}")
    return names


def _time(path: Path, form: FileFormat, table: NDArray[np.void]) -> Stamps:
    """Nanoseconds; stamps since 1970 from their decimal text, since a float would round them."""
    if form.stamp is None or not len(table):
        return np.zeros(len(table), np.int64)
    stamp = table[form.stamp_column]
    if form.stamp == "relative seconds":
        bad = ~(np.abs(stamp) < 9e6)  # beyond, a float is not exact to the nanosecond
        if bad.any():
            fail(path, form, bad, f"the time is {stamp[bad][0]:g}, not {form.stamp}")
        return np.rint(1e9 * stamp).astype(np.int64)
    digits, point, fraction = np.strings.partition(stamp, np.bytes_(b"."))
    if form.stamp == "seconds":
        plain = np.strings.isdigit(digits) & (np.strings.str_len(fraction) <= 9)
        digits = np.strings.add(digits, np.strings.ljust(fraction, 9, np.bytes_(b"0")))
    else:
        plain = np.strings.str_len(point) == 0
    length = np.strings.str_len(digits)
    plain &= np.strings.isdigit(digits) & ((length < 19) | ((length == 19) & (digits < b"9")))
    nanoseconds = np.where(plain, digits, b"0").astype(np.int64)
    for i in np.flatnonzero(~plain):
        nanoseconds[i] = _nanoseconds(stamp[i], 9 if form.stamp == "seconds" else 0)
    if (bad := nanoseconds < 0).any():
        shown = stamp[bad][0].decode(errors="replace")
        fail(path, form, bad, f"the time is {shown}, not {form.stamp} since 1970")
    return nanoseconds


def _nanoseconds(stamp: bytes, power: int) -> int:
    """A stamp times 10 to ``power``, rounded; −1 where it is no time since 1970 (up to 2255), or
    cut short, or, of nanoseconds, not whole."""
    try:
        exact = decimal.Decimal(stamp.decode("ascii")).scaleb(power)
        if exact.adjusted() > 18:
            return -1
        whole = int(exact.to_integral_value(decimal.ROUND_HALF_EVEN))
    except (ArithmeticError, ValueError):
        return -1
    fits = 0 <= whole < 9 * 10**18 and len(stamp) < _STAMP and (power > 0 or whole == exact)
    return whole if fits else -1


def _lines(path: Path, form: FileFormat) -> Iterator[tuple[int, list[str]]]:
    """Line number and fields of every data row, the slow way."""
    with _text(path) as file:
        if form.header:
            reader = csv.reader(file)
            next(reader, None)
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
                empty = not field.strip() and name in form.optional
                if name in form.columns and not empty and not _is_number(field):
                    raise DataError(f"{where}: {name} is {field[:40]!r}, not a number") from None
    raise DataError(f"{path}: cannot be parsed: {' '.join(str(error).split())}") from None


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _cache_folder() -> Path | None:
    """None where no home is known."""
    chosen = os.environ.get("COLOC_CACHE")
    base = chosen or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    try:
        folder = Path(base).expanduser()
    except RuntimeError:
        return None
    return folder if chosen else folder / "coloc"


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
