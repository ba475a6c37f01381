"""Things by name: built in, brought by installed packages, or registered while running.

A built-in is an entry in a table, ``"module:attribute"``, and so is what a package of somebody's
own brings (an entry point of the group): nothing is imported before it is asked for, and lists need
no torch. An own package whose name is taken does not replace what is there: that is an error.
"""

import ast
import importlib
import importlib.util
import inspect
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from coloc_env import options
from coloc_env.options import Option

Factory = Callable[..., Any]
_F = TypeVar("_F", bound=Factory)


class Registry(Mapping[str, Factory]):
    """Factories of one ``kind`` ("scenario") by name; ``group``: of entry points
    ("coloc.scenarios").

    A factory is a function or class; its keyword-only parameters are options.
    """

    def __init__(self, kind: str, group: str, built_in: Mapping[str, str]) -> None:
        self.kind, self.group = kind, group
        self._built_in = dict(built_in)
        self._loaded: dict[str, Factory] = {}
        self._registered: dict[str, Factory] = {}

    @cached_property
    def _references(self) -> dict[str, str]:
        """Name → "module:attribute" of what is built in and of what installed packages bring.

        Raises ValueError where two have one name.
        """
        found = dict(self._built_in)
        for point in _points(self.group):
            if found.setdefault(point.name, point.value) != point.value:
                package = point.dist.name if point.dist else point.module
                raise ValueError(
                    f"{package} brings the {self.kind} {point.name!r}, which exists already "
                    f"({found[point.name]}): another name is needed"
                )
        return found

    def __getitem__(self, name: str) -> Factory:
        """The factory of a name, imported now if it was not. Raises KeyError for an unknown name,
        ValueError where the package that brings it cannot be imported."""
        if name in self._registered:
            return self._registered[name]
        if name not in self._loaded:
            module, _, attribute = self._references[name].partition(":")
            try:
                factory: Factory = getattr(importlib.import_module(module), attribute)
            except (ImportError, AttributeError) as error:
                raise ValueError(f"{self.kind} {name!r} ({module}:{attribute}): {error}") from error
            self._loaded[name] = factory
        return self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        return iter(sorted({*self._references, *self._registered}))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __contains__(self, name: object) -> bool:
        return name in self._registered or name in self._references

    def register(self, name: str) -> Callable[[_F], _F]:
        """A decorator that adds a factory under a name while the program runs; one that was added
        so may be replaced so. Raises ValueError for the name of something that is built in."""
        if name in self._references:
            raise ValueError(f"the {self.kind} {name!r} exists already: another name is needed")

        def add(factory: _F) -> _F:
            self._registered[name] = factory
            return factory

        return add

    def remove(self, name: str) -> None:
        """Take away what was registered while the program runs."""
        del self._registered[name]

    def require(self, name: str) -> Factory:
        """The factory of a name; ValueError, with the closest name and all there are, for an
        unknown one."""
        options.require_known(self.kind, [name], self)
        return self[name]

    def options_of(self, name: str) -> dict[str, Option]:
        """Options of a name's factory. Raises ValueError for an unknown name."""
        return options.of(self.require(name))

    def summary(self, name: str) -> str:
        """First paragraph of the docstring, in one line; read from the source where the module is
        not imported yet."""
        if name in self._registered or name in self._loaded:
            return options.paragraphs(inspect.getdoc(self[name]) or "")[0]
        module, _, attribute = self._references[name].partition(":")
        return options.paragraphs(_docstring(module, attribute))[0]


def _points(group: str) -> list[EntryPoint]:
    return sorted(entry_points(group=group), key=lambda point: point.name)


def _located(module: str) -> ModuleSpec | None:
    """Where a module is, without importing the packages that it lies in; None if nowhere."""
    spec, path, name = None, None, ""
    for part in module.split("."):
        name = f"{name}.{part}" if name else part
        spec = importlib.util.find_spec(name) if path is None else PathFinder.find_spec(name, path)
        if spec is None:
            return None
        path = spec.submodule_search_locations
    return spec


def _docstring(module: str, attribute: str) -> str:
    """The docstring of a module's function or class, from its source; empty if there is none."""
    spec = _located(module)
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return ""
    with open(spec.origin, encoding="utf-8") as file:
        tree = ast.parse(file.read())
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == attribute:
            return ast.get_docstring(node) or ""
    return ""
