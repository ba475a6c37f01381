"""For every test: one thread; studies that take minutes only when asked for; damage to files."""

import json
import os
import random
from collections.abc import Callable, Iterator
from typing import Any

# MKL's products of matrices, and with them the last digits of a row of a batch, then do not depend
# on where in memory the row lies. It has to be said before MKL is first used.
os.environ.setdefault("MKL_CBWR", "AUTO,STRICT")

os.environ.pop("CI", None)  # in which commands say more

import pytest
import torch


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.option.markexpr:
        return
    skip = pytest.mark.skip(reason="slow: run with `pytest -m slow`")
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(skip)


# ---------------------------------------------------------------- damage to small files

_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 3, 1.5, -1e300, 1e300, 10**30, 10**400, 1 << 62, 100_000),
    *("", "none", "\ud800", "a\nb", "x" * 5000, [], {}, [[]], [None], {"": {}}, "1e999", "0"),
)
_TEXTS = (
    "NaN",
    "Infinity",
    "-Infinity",
    "1e999",
    "[" * 20_000,
    '{"a":' * 20_000,
    "0x10",
    "1" * 6000,
)


def _damaged(text: str, seed: int, count: int) -> Iterator[bytes]:
    """``count`` damaged versions of a JSON object."""
    rng = random.Random(seed)
    for i in range(count):
        found = (_value, _value, _value, _text, _bytes, _encoding)[i % 6](text, rng)
        if found != text.encode():
            yield found


def _places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value)
    for key, each in inner:
        yield (*path, key)
        if isinstance(each, dict | list):
            yield from _places(each, (*path, key))


def _value(text: str, rng: random.Random) -> bytes:
    """One value another, missing, or under another name."""
    whole = json.loads(text)
    *outer, key = rng.choice(list(_places(whole)))
    inside: Any = whole
    for step in outer:
        inside = inside[step]
    how = rng.randrange(6)
    if how == 0:
        del inside[key]
    elif how == 1 and isinstance(inside, dict):
        inside[f"{key}x"] = inside.pop(key)
    else:
        inside[key] = rng.choice(_VALUES)
    return json.dumps(whole).encode()


def _text(text: str, rng: random.Random) -> bytes:
    """One number or word written as JSON has none, or as few expect."""
    whole = json.loads(text)
    *outer, key = rng.choice(list(_places(whole)))
    inside: Any = whole
    for step in outer:
        inside = inside[step]
    inside[key] = "@@"
    return json.dumps(whole).replace('"@@"', rng.choice(_TEXTS)).encode()


def _bytes(text: str, rng: random.Random) -> bytes:
    """Cut short, a piece lost or doubled, or some bytes others."""
    data = bytearray(text.encode())
    a, b = sorted(rng.randrange(len(data)) for _ in range(2))
    how = rng.randrange(4)
    if how == 0:
        return bytes(data[:a])
    if how == 1:
        return bytes(data[:a] + data[b:])
    if how == 2:
        return bytes(data[:b] + data[a:])
    for _ in range(rng.randrange(1, 4)):
        data[rng.randrange(len(data))] = rng.randrange(256)
    return bytes(data)


def _encoding(text: str, rng: random.Random) -> bytes:
    return rng.choice(
        [
            text.encode("utf-16"),
            text.encode("utf-32"),
            b"\x00" * len(text),
            b"\xff\xfe" + text.encode(),
            text.encode() + b"\x00",
            text.replace("{", "{\xe9", 1).encode("latin-1", "replace"),
            text.encode() * 2,
            b"",
        ]
    )


@pytest.fixture
def damaged() -> Callable[[str, int, int], Iterator[bytes]]:
    """``damaged(text, seed, count)``: damaged versions of a JSON object, drawn from a seed: what
    disks, editors and people do to files."""
    return _damaged
