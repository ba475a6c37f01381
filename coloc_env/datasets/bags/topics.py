"""``topics.yaml``: which topic of a bag is which table of which robot."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from coloc_env.datasets.open_format.description import KEYS
from coloc_env.datasets.open_format.reader import KNOWN as TABLES
from coloc_env.datasets.open_format.yaml_files import Keys, YamlFile

_KEYS = ("topic", "fields", "names", "scale", "each", "where", "stamp", "to")


@dataclass(frozen=True)
class Topic:
    """One topic that becomes rows of a robot's table.

    ``fields``: column → dotted path in the message (none: by the message's type). ``each``: the
    path of a list whose entries are rows of their own. ``where``: path → text that it must equal.
    ``names``: what stands in a column of names → robot or anchor. ``scale``: numbers that are read
    by paths are multiplied by it. ``stamp``: ``header``, ``received``, or a path to ns or s.
    ``to``: the other end of every range.
    """

    robot: str
    table: str
    topic: str
    fields: Mapping[str, str] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    scale: float = 1.0
    each: str = ""
    where: Mapping[str, str] = field(default_factory=dict)
    stamp: str = "header"
    to: str = ""


@dataclass(frozen=True, eq=False)
class Topics:
    """All topics, and what ``recording.yaml`` is to say."""

    file: YamlFile
    topics: tuple[Topic, ...]
    recording: dict[str, Any]


def read_topics(path: Path) -> Topics:
    """Read and check a ``topics.yaml``.

    Raises:
        DataError: an entry is unknown, missing or no such thing; with file and line.
    """
    file = YamlFile(path)
    file.allow((), ("recording", "robots"))
    file.allow(("recording",), [key for key in KEYS if key not in ("robots", "time")])
    found = []
    if not file.mapping("robots"):
        file.fail(("robots",), "no robots: robots.NAME.TABLE.topic is needed")
    for robot in file.mapping("robots"):
        file.allow(("robots", robot), TABLES, "table")
        for table in file.mapping("robots", robot):
            at = ("robots", robot, table)
            several = file.get(*at)
            if isinstance(several, list):
                found += [_topic(file, (*at, i), robot, table) for i in range(len(several))]
            else:
                found.append(_topic(file, at, robot, table))
    return Topics(file, tuple(found), file.mapping("recording"))


def _topic(file: YamlFile, at: Keys, robot: str, table: str) -> Topic:
    file.allow(at, _KEYS)
    if not file.text(*at, "topic"):
        file.fail(at, "topic is needed")
    texts = {
        name: {key: file.text(*at, name, key) for key in file.mapping(*at, name)}
        for name in ("fields", "names", "where")
    }
    return Topic(
        robot,
        table,
        file.text(*at, "topic"),
        texts["fields"],
        texts["names"],
        file.number(*at, "scale", default=1.0),
        file.text(*at, "each"),
        texts["where"],
        file.text(*at, "stamp", default="header"),
        file.text(*at, "to"),
    )
