"""From a bag to a folder in the open format, message by message: a bag need not fit in memory."""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import yaml

from coloc_env.datasets.bags.messages import (
    LocalOrigin,
    entries_of,
    field_of,
    reader_of,
    stamp_of,
)
from coloc_env.datasets.bags.topics import Topic, Topics, read_topics
from coloc_env.datasets.folders import expanded
from coloc_env.datasets.open_format.description import FILE
from coloc_env.datasets.open_format.reader import read_recording
from coloc_env.datasets.open_format.streams import FILES
from coloc_env.datasets.recording import DataError
from coloc_env.options import unknown
from coloc_env.staging import staged_folder

Progress = Callable[[str, int, int], None]
_OFTEN = 5000  # messages between two words of progress
_TAGS = ("own_tag", "to_tag")  # numbers that are no quantities
_SECONDS = 1e12  # a stamp below this is in s, above it in ns


def import_bag(
    bag: str | os.PathLike[str],
    topics: str | os.PathLike[str],
    out: str | os.PathLike[str],
    progress: Progress = lambda what, done, total: None,
) -> dict[str, int]:
    """Write the topics of a bag that ``topics`` names as a folder in the open format, and say how
    many rows each table has (``robot/table``).

    Stamps are those of the messages' headers unless the file says otherwise. Satellite fixes become
    metres east, north and up of the first one; what a receiver says is no fix is left out and
    counted, like distances beyond a sensor's reach.

    Raises:
        DataError: no bag, a topic or field that is not in it, or a recording that is refused when
            it is read back.
    """
    wanted = read_topics(expanded(topics))
    robots = tuple(dict.fromkeys(topic.robot for topic in wanted.topics))
    with staged_folder(Path(out), (*robots, FILE)) as folder, opened(bag) as reader:
        _require_topics(wanted, reader)
        tables = _Tables(folder, wanted)
        connections = [c for c in reader.connections if c.topic in tables.topics]
        total = sum(c.msgcount for c in connections)
        for done, (connection, received, raw) in enumerate(reader.messages(connections)):
            message = _deserialized(reader, raw, connection)
            tables.add(connection, int(received), message)
            if done % _OFTEN == 0:
                progress("messages", done, total)
        counts = tables.close()
        about = {"name": Path(bag).stem, **wanted.recording, "robots": list(robots)}
        about["time"] = {"unit": "ns", "zero": "epoch"}
        text = yaml.safe_dump(about, sort_keys=False, allow_unicode=True)
        (folder / FILE).write_text(text, encoding="utf-8")
        try:
            read_recording(folder)
        except DataError as error:
            raise DataError(str(error).replace(str(folder), str(out))) from None
    return counts


@contextmanager
def opened(bag: str | os.PathLike[str]) -> Iterator[Any]:
    """A reader of a ROS 1 bag, a ROS 2 bag's folder, or a single file of one."""
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise DataError("bags need rosbags: pip install 'coloc-env[ros]'") from None
    path = expanded(bag)
    if not path.exists():
        raise DataError(f"{path}: no such bag")
    if path.is_file() and path.suffix in (".mcap", ".db3"):
        whole = path.parent / "metadata.yaml"
        path = path.parent if whole.is_file() else path
    try:
        store = get_typestore(Stores.LATEST)
        with AnyReader([path], default_typestore=store) as reader:
            yield reader
    except AnyReaderError as error:
        raise DataError(f"{path}: {' '.join(map(str, error.args))}") from None
    except (OSError, ValueError) as error:
        if isinstance(error, DataError) or "rosbags" not in type(error).__module__:
            raise
        raise DataError(f"{path}: {' '.join(str(error).split())}") from None


class _Tables:
    """The tables that are being written, and the topics that feed them."""

    def __init__(self, folder: Path, wanted: Topics) -> None:
        self.folder, self.file = folder, wanted.file
        self.origin = LocalOrigin()
        self.topics: dict[str, list[Topic]] = {}
        for topic in wanted.topics:
            self.topics.setdefault(topic.topic, []).append(topic)
        self._files: dict[str, TextIO] = {}
        self._columns: dict[str, list[str]] = {}
        self._last: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._unsorted: set[str] = set()

    def add(self, connection: Any, received: int, message: Any) -> None:
        """The rows that a message becomes."""
        for topic in self.topics[connection.topic]:
            where = f"{self.file.path}: {topic.robot}.{topic.table} ({topic.topic})"
            for entry in entries_of(message, topic.each, where):
                if all(str(field_of(entry, k, where)) == v for k, v in topic.where.items()):
                    stamp = self._stamp(topic, entry, message, received, where)
                    cells = self._cells(topic, connection, entry, where)
                    if topic.table != "truth" or _finite(cells):  # else a hole in the truth
                        self._write(topic, stamp, cells)

    def close(self) -> dict[str, int]:
        """Close all files, each in the order of time."""
        for key, file in self._files.items():
            file.close()
            if key in self._unsorted:
                _sort(self.folder / f"{key}.csv")
        return self._counts

    def _stamp(self, topic: Topic, entry: Any, message: Any, received: int, where: str) -> int:
        if topic.stamp == "received":
            return received
        if topic.stamp == "header":
            return stamp_of(entry) or stamp_of(message) or received
        found = field_of(entry, topic.stamp, where)
        with suppress(AttributeError):
            return int(found.sec) * 10**9 + int(found.nanosec)
        try:
            return round(float(found) * 1e9) if abs(found) < _SECONDS else int(found)
        except (TypeError, ValueError):
            raise DataError(f"{where}: {topic.stamp} is {found!r:.60}, no time") from None

    def _cells(self, topic: Topic, connection: Any, entry: Any, where: str) -> dict[str, Any]:
        """The cells of a row."""
        if topic.fields:
            known = FILES[topic.table].columns if topic.table in FILES else {}
            cells = {}
            for column, path in topic.fields.items():
                value = field_of(entry, path, where)
                if known.get(column) == "name":
                    cells[column] = topic.names.get(str(value), str(value))
                else:
                    cells[column] = value if column in _TAGS else value * topic.scale
        else:
            kind = type(entry).__msgtype__ if topic.each else connection.msgtype
            read = reader_of(topic.table, kind, self.origin)
            if read is None:
                raise DataError(f"{where}: {kind} says nothing of {topic.table}; name its fields")
            cells = dict(read(entry))
        if topic.to:
            cells["to"] = topic.to
        return cells

    def _write(self, topic: Topic, stamp: int, cells: dict[str, Any]) -> None:
        key = f"{topic.robot}/{topic.table}"
        if key not in self._files:
            path = self.folder / f"{key}.csv"
            path.parent.mkdir(exist_ok=True)
            self._files[key] = path.open("w", encoding="utf-8", newline="\n")
            self._columns[key] = list(cells)
            self._files[key].write(",".join(("stamp", *cells)) + "\n")
        if list(cells) != self._columns[key]:
            raise DataError(f"{self.file.path}: {key}: its topics fill different columns")
        self._files[key].write(",".join((str(stamp), *map(_cell, cells.values()))) + "\n")
        if stamp < self._last.get(key, stamp):
            self._unsorted.add(key)
        self._last[key] = stamp
        self._counts[key] = self._counts.get(key, 0) + 1


def _require_topics(wanted: Topics, reader: Any) -> None:
    """Refuse topics that the bag does not have."""
    known = sorted({connection.topic for connection in reader.connections})
    for topic in wanted.topics:
        if topic.topic not in known:
            wanted.file.fail(
                ("robots", topic.robot, topic.table), unknown("topic", topic.topic, known)
            )


def _deserialized(reader: Any, raw: bytes, connection: Any) -> Any:
    try:
        return reader.deserialize(raw, connection.msgtype)
    except Exception as error:  # a damaged message raises errors of many kinds
        text = " ".join(str(error).split())[:100]
        raise DataError(
            f"{connection.topic}: a {connection.msgtype} that cannot be read: {text}"
        ) from None


def _finite(cells: Mapping[str, Any]) -> bool:
    return all(np.isfinite(value) for value in cells.values())


def _cell(value: Any) -> str:
    text = repr(float(value)) if hasattr(value, "__float__") else str(value)
    return '"' + text.replace('"', '""') + '"' if set(text) & set(',"\n') else text


def _sort(path: Path) -> None:
    """Put a table's rows into the order of their stamps."""
    head, *rows = path.read_text(encoding="utf-8").splitlines()
    rows.sort(key=lambda row: int(row.partition(",")[0]))
    path.write_text("\n".join((head, *rows)) + "\n", encoding="utf-8")
