"""Things by name: built in, brought by installed packages, or registered while running.

A built-in is an entry in a table, ``"module:attribute"``, and so is what a package of somebody's
own brings (an entry point of the group): nothing is imported before it is asked for, and lists need
no torch. An own package whose name is taken does not replace what is there: that is an error.
"""

import ast
import importlib
import importlib.util
import inspect
import tokenize
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property, reduce
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
            value = f"{point.module}:{point.attr}"
            if found.setdefault(point.name, value) != value:
                package = point.dist.name if point.dist else point.module
                raise ValueError(
                    f"{package} brings the {self.kind} {point.name!r}, which exists already "
                    f"({found[point.name]}): another name is needed"
                )
        return found

    def __getitem__(self, name: str) -> Factory:
        """The factory of a name, imported now if it was not. Raises KeyError for an unknown name,
        ValueError where the package that brings it cannot be imported, whatever it raises then."""
        if name in self._registered:
            return self._registered[name]
        if name not in self._loaded:
            module, _, attribute = self._references[name].partition(":")
            where = f"{self.kind} {name!r} ({module}:{attribute})"
            try:
                home: Any = importlib.import_module(module)
                factory: Factory = reduce(getattr, attribute.split("."), home)
            except (Exception, SystemExit) as error:
                raise ValueError(f"{where}: {_words(error)}") from error
            if not callable(factory):
                raise ValueError(f"{where}: a function or class is needed, not {factory!r}")
            self._loaded[name] = factory
        return self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        return iter(sorted({*self._references, *self._registered}))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __contains__(self, name: object) -> bool:
        return name in self._registered or name in self._references

    def names(self) -> list[str]:
        """All names; one that two packages have taken counts once, and is no error here."""
        taken = (point.name for point in _points(self.group))
        return sorted({*self._built_in, *taken, *self._registered})

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
        """Options of a name's factory. Raises ValueError for an unknown name, and where a package
        annotates them with what cannot be read."""
        factory = self.require(name)
        try:
            return options.of(factory)
        except Exception as error:
            what = f"{self.kind} {name!r}: its options cannot be read"
            raise ValueError(f"{what}: {_words(error)}") from error

    def module(self, name: str) -> str:
        """The module that a name's factory is from; nothing is imported."""
        if name in self._registered:
            return self._registered[name].__module__
        return self._references[name].partition(":")[0]

    def summary(self, name: str) -> str:
        """First paragraph of the docstring, in one line; read from the source where the module is
        not imported yet. Where that cannot be read, what is wrong, in brackets."""
        if name in self._registered or name in self._loaded:
            return options.paragraphs(inspect.getdoc(self[name]) or "")[0]
        module, _, attribute = self._references[name].partition(":")
        try:
            return options.paragraphs(_docstring(module, attribute))[0]
        except (OSError, SyntaxError, ValueError) as error:
            return f"({module}: {_words(error)})"


def _words(error: BaseException) -> str:
    """An error in one line, with its kind where that says more than its text."""
    text = " ".join(str(error).split())
    plain = isinstance(error, ImportError | AttributeError)
    return text if plain and text else f"{type(error).__name__}: {text}"


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
    """The docstring of a module's function or class, from its source; empty if there is none.
    Raises OSError where there is no such module, SyntaxError where it is no Python."""
    spec = _located(module)
    if spec is None:
        raise FileNotFoundError("no such module")
    if spec.origin is None or not spec.origin.endswith(".py"):
        return ""
    with tokenize.open(spec.origin) as file:
        tree = ast.parse(file.read())
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == attribute:
            return ast.get_docstring(node) or ""
    return ""
