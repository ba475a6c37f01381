"""Reading JSON files that people, other programs or a failing disk may have changed."""

import json
import typing
from collections.abc import Mapping
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from coloc_env import options


def read_json(
    file: Path | Traversable,
    what: str,
    needed: Mapping[str, Any],
    optional: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The object in a file, with fields of the annotated types (as options have them, and
    ``dict[str, T]``): all that are ``needed``, and the ``optional`` ones that are there.

    UTF-8, with or without a byte order mark. Raises ValueError, in one line that names the file,
    ``what`` it should be ("a checkpoint's card") and what is wrong: no JSON, a key that comes
    twice, NaN or infinity, a field that is missing or of another type.
    """
    try:
        text = file.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{file} is not UTF-8 text: {error.reason}") from None
    try:
        found = json.loads(
            text, object_pairs_hook=_once, parse_constant=_finite, parse_float=_finite
        )
        json.dumps(found, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise ValueError(f"{file} is not JSON: it holds half of a character") from None
    except RecursionError:
        raise ValueError(f"{file} is nested too deeply to be {what}") from None
    except ValueError as error:
        raise ValueError(f"{file} is not JSON: {error}") from None
    if not isinstance(found, dict):
        raise ValueError(f"{file} is not {what}: {', '.join(needed)} are needed")
    for key, annotation in {**needed, **(optional or {})}.items():
        if key not in found:
            if key in needed:
                raise ValueError(f"{file} is not {what}: {key!r} is missing")
        elif not _fits(found[key], annotation):
            raise ValueError(
                f"{file} is not {what}: {key!r} is {_short(found[key])}, "
                f"{_describe(annotation)} is needed"
            )
    return found


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice!r} comes twice")
    return found


def _finite(text: str) -> float:
    value = float(text)
    if value - value != 0:
        raise ValueError(f"{text} is not a finite number")
    return value


def _fits(value: Any, annotation: Any) -> bool:
    if typing.get_origin(annotation) is dict:
        (_, inner) = typing.get_args(annotation)
        return isinstance(value, dict) and all(options.fits(one, inner) for one in value.values())
    return options.fits(value, annotation)


def _describe(annotation: Any) -> str:
    if annotation is dict:
        return "an object"
    if typing.get_origin(annotation) is dict:
        return f"an object, each of its values {options.describe(typing.get_args(annotation)[1])},"
    if typing.get_origin(annotation) is tuple:
        return "a list of names"
    return options.describe(annotation)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}…"
