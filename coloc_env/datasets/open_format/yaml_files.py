"""YAML files that people write: read with the line of every entry, refused in one line."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

import yaml

from coloc_env.datasets.recording import DataError
from coloc_env.options import unknown

Keys = tuple[str | int, ...]
_MOST = 1 << 20  # characters of a file
_DEEPEST = 20
_LARGEST = 1e12  # of a number, in any unit
_ENTRIES = 100_000


class YamlFile:
    """A mapping in a YAML file. Entries are named by their keys from the outermost one on; what is
    asked for and not there, or of another kind, is a DataError that names file, line and entry."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lines: dict[Keys, int] = {(): 1}
        try:
            text = path.read_bytes().decode("utf-8-sig")
        except UnicodeDecodeError:
            raise DataError(f"{path}: not UTF-8 text") from None
        except OSError as error:
            raise DataError(f"{path}: {error.strerror or 'cannot be read'}") from None
        if len(text) > _MOST:
            raise DataError(f"{path}: {len(text)} characters, more than such a file has")
        try:
            node = yaml.compose(text, yaml.SafeLoader)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            line = mark.line + 1 if mark else 1
            raise DataError(f"{path}, line {line}: not YAML: {error.problem}") from None
        except (yaml.YAMLError, RecursionError, ValueError) as error:
            raise DataError(f"{path}: not YAML: {' '.join(str(error).split())}") from None
        self.content = {} if node is None else self._plain(node, ())
        if not isinstance(self.content, dict):
            raise DataError(f"{path}, line 1: no 'key: value' entries")

    def fail(self, keys: Keys, reason: str) -> NoReturn:
        """Raise a DataError that names the entry and its line."""
        known = keys
        while known not in self._lines:
            known = known[:-1]
        name = ".".join(map(str, keys))
        where = f"{name}: " if name else ""
        raise DataError(f"{self.path}, line {self._lines[known]}: {where}{reason}")

    def get(self, *keys: str | int) -> Any:
        """What stands there; None if nothing does."""
        found: Any = self.content
        for key in keys:
            if isinstance(found, dict):
                found = found.get(key)
            elif isinstance(found, list) and isinstance(key, int):
                found = found[key]
            else:
                return None
        return found

    def mapping(self, *keys: str | int) -> dict[str, Any]:
        """A mapping; an empty one if nothing stands there."""
        found = self.get(*keys)
        if found is None:
            return {}
        if not isinstance(found, dict):
            self.fail(keys, f"{_short(found)} is not 'key: value' entries")
        return found

    def allow(self, keys: Keys, known: Iterable[str], what: str = "entry") -> None:
        """Refuse entries of a mapping that are not known."""
        known = list(known)
        for key in self.mapping(*keys):
            if key not in known:
                self.fail((*keys, key), unknown(what, key, known))

    def text(self, *keys: str | int, default: str = "") -> str:
        found = self.get(*keys)
        if found is None:
            return default
        if isinstance(found, dict | list):
            self.fail(keys, f"{_short(found)} is not a text")
        return str(found)

    def choice(self, keys: Keys, allowed: Iterable[str], default: str) -> str:
        """One of some words."""
        found, allowed = self.text(*keys, default=default), list(allowed)
        if found not in allowed:
            self.fail(keys, f"{found!r} is not one of {', '.join(allowed)}")
        return found

    def flag(self, *keys: str | int) -> bool:
        """True or false; false if nothing stands there."""
        found = self.get(*keys)
        if found is not None and not isinstance(found, bool):
            self.fail(keys, f"{_short(found)} is not true or false")
        return bool(found)

    def number(self, *keys: str | int, default: float | None = None) -> float:
        """A finite number."""
        found = self.get(*keys)
        if found is None and default is not None:
            return default
        value = _number(found)
        if value is None:
            self.fail(keys, f"{_short(found)} is not a finite number")
        return value

    def whole(self, *keys: str | int, default: int) -> int:
        """A whole number."""
        found = self.get(*keys)
        if found is None:
            return default
        if isinstance(found, bool) or not isinstance(found, int) or abs(found) >= 1 << 62:
            self.fail(keys, f"{_short(found)} is not a whole number")
        return found

    def vector(self, *keys: str | int, size: int) -> list[float]:
        """So many finite numbers."""
        found = self.get(*keys)
        numbers = [_number(each) for each in found] if isinstance(found, list) else []
        if len(numbers) != size or None in numbers:
            self.fail(keys, f"{_short(found)} is not {size} finite numbers, as in [1.0, 2.0]")
        return [number for number in numbers if number is not None]

    def names(self, *keys: str | int) -> list[str]:
        """A list of different texts; empty if nothing stands there."""
        found = self.get(*keys)
        if found is None:
            return []
        if not isinstance(found, list) or any(isinstance(each, dict | list) for each in found):
            self.fail(keys, f"{_short(found)} is not a list of names")
        names = [str(each) for each in found]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            self.fail(keys, f"{twice!r} stands there twice")
        return names

    def _plain(self, node: yaml.Node, keys: Keys) -> Any:
        """The values of a tree of nodes, whose lines are kept."""
        self._lines[keys] = node.start_mark.line + 1
        if len(keys) > _DEEPEST or len(self._lines) > _ENTRIES:
            self.fail(keys[:3], "nested too deeply, or too long")
        if isinstance(node, yaml.MappingNode):
            found = {}
            for key_node, value_node in node.value:
                key = key_node.value if isinstance(key_node, yaml.ScalarNode) else None
                self._lines[(*keys, str(key))] = key_node.start_mark.line + 1
                if key is None or key == "<<":
                    self.fail((*keys, str(key)), "a key must be a plain name")
                if key in found:
                    self.fail((*keys, key), "stands there twice")
                found[key] = self._plain(value_node, (*keys, key))
            return found
        if isinstance(node, yaml.SequenceNode):
            return [self._plain(each, (*keys, i)) for i, each in enumerate(node.value)]
        loader = yaml.SafeLoader("")
        try:
            return loader.construct_object(node)
        except (yaml.YAMLError, ValueError, OverflowError):
            self.fail(keys, f"{node.value[:40]!r} is no value of YAML")


def _number(value: Any) -> float | None:
    """A finite number of sane size; YAML takes ``1e-3`` for a text."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) and abs(number) <= _LARGEST else None


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}…"
