"""Scenarios by id: what exists, which overrides each takes, and clear words for what it does not."""

import difflib
import inspect
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any

from coloc_env.scenario import Scenario

Family = Callable[..., Scenario]
FAMILIES: dict[str, Family] = {}


def register(name: str) -> Callable[[Family], Family]:
    """Register a scenario family: a function of keyword overrides that returns a Scenario."""

    def add(family: Family) -> Family:
        FAMILIES[name] = family
        return family

    return add


def overrides_of(name: str) -> dict[str, inspect.Parameter]:
    """Override names of a scenario with their types and defaults."""
    signature = inspect.signature(_family(name), eval_str=True)
    return dict(signature.parameters)


def make_scenario(name: str, **overrides: Any) -> Scenario:
    """Build a registered scenario.

    Raises ValueError, in one line that names what is allowed, for an unknown scenario, an unknown
    override, or a value of the wrong type or range.
    """
    family, known = _family(name), overrides_of(name)
    for key, value in overrides.items():
        if key not in known:
            raise ValueError(
                f"{name}: unknown override {key!r}{_did_you_mean(key, known)}; "
                f"allowed: {', '.join(known)}"
            )
        if not _fits(value, known[key].annotation):
            raise ValueError(
                f"{name}: {key}={value!r} is not allowed: {describe(known[key].annotation)} is needed"
            )
    try:
        return family(**overrides)
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(name) else f"{name}: {text}") from error


def parse_override(name: str, text: str) -> tuple[str, Any]:
    """``key=value`` from a command line, the value read as the override's type.

    Lists of numbers are written ``30,20,5``, time spans ``40:60``, nothing ``none``.
    """
    key, separator, value = text.partition("=")
    if not separator:
        raise ValueError(f"override {text!r}: write it as key=value")
    known = overrides_of(name)
    if key not in known:
        make_scenario(name, **{key: value})  # raises with the list of what is allowed
    annotation = known[key].annotation
    for kind in _alternatives(annotation):
        parsed = _parse(value, kind)
        if parsed is not _UNFIT:
            return key, parsed
    raise ValueError(f"{name}: {key}={value!r} is not allowed: {describe(annotation)} is needed")


_UNFIT = object()


def _family(name: str) -> Family:
    if name not in FAMILIES:
        raise ValueError(
            f"unknown scenario {name!r}{_did_you_mean(name, FAMILIES)}; "
            f"known: {', '.join(sorted(FAMILIES))}"
        )
    return FAMILIES[name]


def _did_you_mean(key: str, known: Mapping[str, Any]) -> str:
    close = difflib.get_close_matches(key, list(known), 1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def _alternatives(annotation: Any) -> list[Any]:
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return list(typing.get_args(annotation))
    return [annotation]


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
        if typing.get_origin(kind) is tuple:
            inner = typing.get_args(kind)
            size = "" if inner[-1] is Ellipsis else f"{len(inner)} "
            parts.append(f"{size}numbers separated by ',' or ':'")
        elif typing.get_origin(kind) is typing.Literal:
            parts.append("one of " + ", ".join(map(str, typing.get_args(kind))))
        else:
            parts.append(words.get(kind, getattr(kind, "__name__", str(kind))))
    return " or ".join(parts)


def _fits(value: Any, annotation: Any) -> bool:
    return any(_fits_one(value, kind) for kind in _alternatives(annotation))


def _fits_one(value: Any, kind: Any) -> bool:
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        if not isinstance(value, (tuple, list)):
            return False
        kinds = [inner[0]] * len(value) if inner[-1] is Ellipsis else list(inner)
        return len(kinds) == len(value) and all(map(_fits, value, kinds))
    if origin is typing.Literal:
        return value in inner
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
        return text if text in inner else _UNFIT
    try:
        return kind(text)
    except ValueError:
        return _UNFIT
