"""Tables that people make (CSV, Parquet, TUM): columns by name, checked to the last cell."""

import csv
import io
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np

from coloc_env.datasets.open_format.stamps import FARTHEST_TIME, from_numbers, nanoseconds
from coloc_env.datasets.recording import DataError, Flags, Floats, Stamps

Kind = Literal["number", "measured", "name"]
"""What a column holds: a finite number in every row; a measurement that may be missing, which is
then NaN; a name."""

TUM = ("stamp", "x", "y", "z", "qx", "qy", "qz", "qw")
_STAMP = 48  # characters of a stamp
_MOST = 1e9  # of anything recorded, in any unit
DELIMITERS = ",;\t"


@dataclass(frozen=True, eq=False)
class Columns:
    """The columns of a file that are known, T rows; ``unused``: names of its other columns."""

    path: Path
    time: Stamps
    numbers: dict[str, Floats]
    names: dict[str, list[str]]
    unused: tuple[str, ...] = ()
    lines: Sequence[int] = field(default=(), repr=False)
    word: str = "line"

    def __len__(self) -> int:
        return len(self.time)

    def __contains__(self, column: str) -> bool:
        return column in self.numbers or column in self.names

    def fail(self, bad: Flags, column: str, reason: str) -> NoReturn:
        """Raise a DataError that names file, line, column and value of the first ``bad`` row."""
        row = int(bad.argmax())
        values = self.names.get(column)
        value = repr(values[row]) if values else f"{self.numbers[column][row]:g}"
        raise DataError(
            f"{self.path}, {self.word} {self.lines[row]}, column {column}: {value} {reason}"
        )

    def refuse(self, reason: str) -> NoReturn:
        """Raise a DataError about the whole table."""
        raise DataError(f"{self.path}, {self.word} 1: {reason}")

    def require(self, *columns: str) -> Floats:
        """Columns [T, F] of numbers; DataError if one is not there."""
        for column in columns:
            if column not in self:
                raise DataError(f"{self.path}, line 1: there is no column {column!r}")
        return np.stack([self.numbers[column] for column in columns], 1)

    def rows(self, chosen: Flags) -> "Columns":
        """Some of the rows."""
        index = np.flatnonzero(chosen)
        return replace(
            self,
            time=self.time[chosen],
            numbers={name: values[chosen] for name, values in self.numbers.items()},
            names={name: [values[i] for i in index] for name, values in self.names.items()},
            lines=[self.lines[int(i)] for i in index],
        )


def read_columns(path: Path, known: Mapping[str, Kind], unit: str) -> Columns:
    """The ``stamp`` (in ``unit``) and the known columns of a file, in whatever order they stand.

    Names are found whatever their case; commas, semicolons or tabs part cells; marks of byte order,
    line ends of any system, blank lines and lines that begin with ``#`` are no fault.

    Raises:
        DataError: the file is missing or not text, a cell is missing or no number, a time is before
            the one above; with file, line, column and value.
    """
    if path.suffix == ".parquet":
        found = _read_parquet(path, known, unit)
    elif path.suffix in (".tum", ".txt"):
        rows, lines = _words(path)
        found = _typed(path, TUM, rows, lines, dict.fromkeys(TUM[1:], "number"), "s")
    else:
        found = _read_csv(path, known, unit)
    back = np.diff(found.time, prepend=found.time[:1]) < 0
    if back.any():
        row = int(back.argmax())
        where = f"{path}, {found.word} {found.lines[row]}, column stamp"
        apart = (found.time[row - 1] - found.time[row]) * 1e-9
        raise DataError(f"{where}: the time is {apart:g} s before that of the row above")
    check_numbers(found, known)
    return found


def check_numbers(found: Columns, known: Mapping[str, Kind]) -> None:
    """Refuse numbers that nobody can have measured (DataError); what is measured and beyond all
    measure becomes infinite."""
    for name, values in found.numbers.items():
        kind = known.get(name, "number")
        if kind == "number" and (bad := ~np.isfinite(values)).any():
            found.fail(bad, name, "is not a finite number")
        if kind == "measured":
            values[np.abs(values) > _MOST] = np.inf
        elif (bad := np.abs(values) > _MOST).any():
            found.fail(bad, name, f"is beyond {_MOST:g}")


# ------------------------------------------------------------------ text


def _text(path: Path) -> str:
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: {error.strerror or 'cannot be read'}") from None
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise DataError(f"{path}: UTF-16 text; save it as UTF-8")
    text = raw.decode("utf-8-sig", errors="replace")
    if "\0" in text:
        raise DataError(f"{path}: not a text file")
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def _read_csv(path: Path, known: Mapping[str, Kind], unit: str) -> Columns:
    text = _text(path)
    head, _, body = text.partition("\n")
    delimiter, header = _header(path, head)
    quick = _quick(path, header, body, delimiter, known, unit)
    if quick is not None:
        return quick
    wide = len(header)
    if '"' in text:
        rows, lines = _quoted(path, text, delimiter)
        cells = [row for row in rows if row]
    else:
        blank = f"{delimiter} "
        every = body.split("\n")
        kept = [(i, line) for i, line in enumerate(every, 2) if line.strip(blank)]
        kept = [(i, line) for i, line in kept if line[0] != "#"] if "#" in body else kept
        lines = [i for i, _ in kept]
        bad = next(((i, row) for i, row in kept if row.count(delimiter) != wide - 1), None)
        if bad is not None:
            count = bad[1].count(delimiter) + 1
            raise DataError(f"{path}, line {bad[0]}: {count} columns, not {wide}: {bad[1][:40]!r}")
        flat = delimiter.join(line for _, line in kept).split(delimiter) if kept else []
        return _typed_flat(path, header, flat, lines, known, unit, plain=_plain(body))
    for line, row in zip(lines, cells, strict=True):
        if len(row) != wide:
            raise DataError(f"{path}, line {line}: {len(row)} columns, not {wide}")
    flat = [cell for row in cells for cell in row]
    return _typed_flat(path, header, flat, lines, known, unit, plain=False)


def _quick(
    path: Path,
    header: Sequence[str],
    body: str,
    delimiter: str,
    known: Mapping[str, Kind],
    unit: str,
) -> Columns | None:
    """The columns of a table of nothing but numbers, a row a line, in a quarter of the time; None
    for any other, and where something is amiss."""
    wanted = [name for name in header if name in known]
    numeric = all(known[name] == "number" for name in wanted)
    once = all(header.count(name) == 1 for name in ("stamp", *wanted))
    if not (numeric and once and body.strip() and _plain(body)):
        return None
    if "\n\n" in body or body[0] == "\n" or '"' in body or "#" in body:
        return None
    kinds = dict.fromkeys(wanted, "f8") | {"stamp": "i8" if unit == "ns" else f"S{_STAMP}"}
    dtype = [(f"{i}", kinds.get(name, "S1")) for i, name in enumerate(header)]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            table = np.loadtxt(io.StringIO(body), dtype, None, delimiter, ndmin=1)
        stamp = table[str(header.index("stamp"))]
        if unit == "ns":
            time = stamp if (np.abs(stamp) < FARTHEST_TIME).all() else None
        else:
            texts = [text.decode("ascii") for text in stamp.tolist()]
            time = nanoseconds(texts, unit) if max(map(len, texts)) < _STAMP else None
    except (ValueError, OverflowError, Warning):
        return None
    if time is None:
        return None
    numbers = {name: table[str(header.index(name))].copy() for name in wanted}
    unused = tuple(name for name in header if name != "stamp" and name not in known)
    return Columns(path, time.copy(), numbers, {}, unused, range(2, len(time) + 2))


def _plain(text: str) -> bool:
    """Whether what Python takes for a number is one in any language."""
    return text.isascii() and "_" not in text


def _quoted(path: Path, text: str, delimiter: str) -> tuple[list[list[str]], list[int]]:
    """Rows below the header of a file with quotation marks, and their lines."""
    reader = csv.reader(io.StringIO(text), delimiter=delimiter, strict=True)
    rows, lines, before = [], [], 0
    try:
        for row in reader:
            line, before = before + 1, reader.line_num
            if line > 1 and any(cell.strip() for cell in row) and row[0][:1] != "#":
                rows.append(row)
                lines.append(line)
    except csv.Error as error:
        raise DataError(f"{path}, line {reader.line_num}: {error}") from None
    return rows, lines


def _words(path: Path) -> tuple[list[list[str]], list[int]]:
    """Rows of a file whose columns are parted by white space."""
    rows, lines = [], []
    for i, line in enumerate(_text(path).split("\n"), 1):
        if row := line.split("#")[0].split():
            rows.append(row)
            lines.append(i)
    return rows, lines


def _typed(
    path: Path,
    header: Sequence[str],
    rows: list[list[str]],
    lines: list[int],
    known: Mapping[str, Any],
    unit: str,
) -> Columns:
    for line, row in zip(lines, rows, strict=True):
        if len(row) != len(header):
            raise DataError(f"{path}, line {line}: {len(row)} columns, not {len(header)}")
    flat = [cell for row in rows for cell in row]
    return _typed_flat(path, header, flat, lines, known, unit, plain=False)


def _header(path: Path, head: str) -> tuple[str, list[str]]:
    """The delimiter of a file and the names of its columns."""
    head = head.lstrip("#")
    cut = {
        mark: [cell.strip().strip('"').lower() for cell in head.split(mark)] for mark in DELIMITERS
    }
    having = {mark: names for mark, names in cut.items() if "stamp" in names}
    if not having:
        names = max(cut.values(), key=len)
        raise DataError(f"{path}, line 1: no column 'stamp' among {', '.join(names)[:80]!r}")
    delimiter = max(having, key=lambda mark: len(having[mark]))
    return delimiter, having[delimiter]


def _typed_flat(
    path: Path,
    header: Sequence[str],
    flat: list[str],
    lines: list[int],
    known: Mapping[str, Any],
    unit: str,
    plain: bool,
) -> Columns:
    """The columns of rows that were joined, each read as what it holds."""
    wide = len(header)
    for name in ("stamp", *known):
        if header.count(name) > 1:
            raise DataError(f"{path}, line 1: the column {name!r} stands there twice")
    at = header.index("stamp")
    texts = flat[at::wide]
    try:
        time = nanoseconds(texts, unit)
        if not plain and any(not text.isascii() for text in texts):
            raise ValueError(next(i for i, text in enumerate(texts) if not text.isascii()))
    except ValueError as error:
        row = int(error.args[0])
        where = f"{path}, line {lines[row]}, column stamp"
        raise DataError(f"{where}: {texts[row][:40]!r} is not a time in {unit}") from None
    numbers, names = {}, {}
    for i, name in enumerate(header):
        if name not in known:
            continue
        cells = flat[i::wide]
        if known[name] == "name":
            names[name] = [cell.strip() for cell in cells]
            continue
        if known[name] == "measured" and any(not cell or cell.isspace() for cell in cells):
            cells = [cell if cell.strip() else "nan" for cell in cells]
        try:
            if not plain and not all(_plain(cell) for cell in cells):
                raise ValueError
            numbers[name] = np.fromiter(map(float, cells), np.float64, len(cells))
        except ValueError:
            row = next(k for k, cell in enumerate(cells) if not _is_number(cell))
            where = f"{path}, line {lines[row]}, column {name}"
            raise DataError(f"{where}: {cells[row][:40]!r} is not a number") from None
    unused = tuple(name for name in header if name != "stamp" and name not in known)
    return Columns(path, time, numbers, names, unused, lines)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return _plain(cell)


# ------------------------------------------------------------------ Parquet


def _read_parquet(path: Path, known: Mapping[str, Kind], unit: str) -> Columns:
    try:
        import pyarrow
        import pyarrow.parquet as parquet
    except ImportError:
        raise DataError(f"{path}: Parquet needs pyarrow: pip install 'coloc-env[ros]'") from None
    try:
        table = parquet.read_table(path)
    except (OSError, pyarrow.ArrowException) as error:
        raise DataError(f"{path}: not Parquet: {' '.join(str(error).split())[:80]}") from None
    header = [name.strip().lower() for name in table.column_names]
    for name in ("stamp", *known):
        if header.count(name) > 1:
            raise DataError(f"{path}: the column {name!r} is there twice")
    if "stamp" not in header:
        raise DataError(f"{path}: no column 'stamp' among {', '.join(header)[:80]!r}")
    rows = range(1, table.num_rows + 1)
    numbers: dict[str, Floats] = {}
    names: dict[str, list[str]] = {}
    time = np.empty(0, np.int64)
    for name, column in zip(header, table.columns, strict=True):
        if known.get(name) == "name":
            names[name] = ["" if value is None else str(value) for value in column.to_pylist()]
            continue
        if name != "stamp" and name not in known:
            continue
        if pyarrow.types.is_timestamp(column.type):
            column, unit = column.cast(pyarrow.timestamp("ns")).cast(pyarrow.int64()), "ns"
        whole = pyarrow.types.is_integer(column.type)
        if not whole and not pyarrow.types.is_floating(column.type):
            raise DataError(f"{path}, column {name}: {column.type} is not numbers")
        if name == "stamp":
            try:
                if column.null_count:
                    raise ValueError(column.to_pylist().index(None))
                time = from_numbers(column.to_numpy(), unit)
            except ValueError as error:
                where = f"{path}, row {int(error.args[0]) + 1}, column stamp"
                raise DataError(f"{where}: not a time in {unit}") from None
        else:
            numbers[name] = column.to_numpy().astype(np.float64)
    unused = tuple(name for name in header if name != "stamp" and name not in known)
    return Columns(path, time, numbers, names, unused, rows, "row")
