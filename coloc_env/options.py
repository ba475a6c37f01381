"""Keyword options with types: checked when called from Python, parsed when typed on a command line.

Scenario overrides and agent options are the keyword-only parameters of a function or class; their
annotations say what fits. Every refusal is one line that names the key and what is allowed.
"""

import difflib
import inspect
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from typing import Any

_UNFIT = object()


def parameters(function: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Keyword-only parameters of a function or class, annotations evaluated; a class that takes
    ``**options`` passes them on to the class it extends, and so has that one's, too."""
    own = inspect.signature(function, eval_str=True).parameters
    named = {k: p for k, p in own.items() if p.kind is p.KEYWORD_ONLY}
    if isinstance(function, type) and any(p.kind is p.VAR_KEYWORD for p in own.values()):
        extended = parameters(function.__mro__[1])
        return named | {k: p for k, p in extended.items() if k not in named}
    return named


def check(owner: str, options: Mapping[str, Any], known: Mapping[str, inspect.Parameter]) -> None:
    """Raise ValueError for an unknown option or a value that does not fit its type."""
    for key, value in options.items():
        _known(owner, key, known)
        if not fits(value, known[key].annotation):
            raise ValueError(_unfit(owner, key, value, known))


def parse(owner: str, text: str, known: Mapping[str, inspect.Parameter]) -> tuple[str, Any]:
    """``key=value`` from a command line, the value read as the option's type.

    Lists of numbers are written ``30,20,5``, time spans ``40:60``, nothing ``none``.
    """
    key, separator, value = text.partition("=")
    if not separator:
        raise ValueError(f"{owner}: option {text!r} is not of the form key=value")
    _known(owner, key, known)
    for kind in _alternatives(known[key].annotation):
        parsed = _parse(value, kind)
        if parsed is not _UNFIT:
            return key, parsed
    raise ValueError(_unfit(owner, key, value, known))


def require_known(what: str, wanted: Iterable[str] | None, known: Iterable[str]) -> None:
    """Raise ValueError for a wanted name that does not exist; None wants nothing in particular."""
    names = list(known)
    for key in wanted or ():
        if key not in names:
            raise ValueError(unknown(what, key, names))


def unknown(what: str, key: str, known: Iterable[str]) -> str:
    """The words for a name that does not exist: the closest one, and all there are."""
    names = list(known)
    close = difflib.get_close_matches(key, names, 1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    return f"unknown {what} {key!r}{hint}; known: {', '.join(names) or 'none'}"


def describe(annotation: Any) -> str:
    """A type in a user's words."""
    words = {
        int: "a whole number",
        float: "a number",
        str: "a name",
        bool: "true or false",
        type(None): "none",
    }
    parts = []
    for kind in _alternatives(annotation):
        inner = typing.get_args(kind)
        if typing.get_origin(kind) is tuple:
            size = "" if inner[-1] is Ellipsis else f"{len(inner)} "
            parts.append(f"{size}numbers separated by ',' or ':'")
        elif typing.get_origin(kind) is typing.Literal:
            parts.append("one of " + ", ".join(map(str, inner)))
        else:
            parts.append(words.get(kind, getattr(kind, "__name__", str(kind))))
    return " or ".join(parts)


def fits(value: Any, annotation: Any) -> bool:
    """Whether a value is of an annotated type (an int fits float; bool fits neither)."""
    return any(_fits(value, kind) for kind in _alternatives(annotation))


def _known(owner: str, key: str, known: Mapping[str, inspect.Parameter]) -> None:
    if key not in known:
        raise ValueError(f"{owner}: {unknown('option', key, known)}")


def _unfit(owner: str, key: str, value: Any, known: Mapping[str, inspect.Parameter]) -> str:
    needed = describe(known[key].annotation)
    return f"{owner}: {key}={value!r} is not allowed: {needed} is needed"


def _alternatives(annotation: Any) -> list[Any]:
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return list(typing.get_args(annotation))
    return [annotation]


def _fits(value: Any, kind: Any) -> bool:
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        if not isinstance(value, (tuple, list)):
            return False
        kinds = [inner[0]] * len(value) if inner[-1] is Ellipsis else list(inner)
        return len(kinds) == len(value) and all(map(fits, value, kinds))
    if origin is typing.Literal:
        return any(type(value) is type(each) and value == each for each in inner)
    if kind is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and value == value
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, kind)


def _parse(text: str, kind: Any) -> Any:
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if kind is type(None):
        return None if text.lower() == "none" else _UNFIT
    if kind is bool:
        return {"true": True, "false": False, "1": True, "0": False}.get(text.lower(), _UNFIT)
    if origin is tuple:
        pieces = text.replace(":", ",").split(",")
        kinds = [inner[0]] * len(pieces) if inner[-1] is Ellipsis else list(inner)
        if len(kinds) != len(pieces):
            return _UNFIT
        values = tuple(_parse(piece, k) for piece, k in zip(pieces, kinds, strict=True))
        return _UNFIT if _UNFIT in values else values
    if origin is typing.Literal:
        return next((each for each in inner if str(each) == text), _UNFIT)
    try:
        value = kind(text)
    except ValueError:
        return _UNFIT
    return value if fits(value, kind) else _UNFIT
