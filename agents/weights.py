"""Reading the weights of learned parts: NAME.safetensors beside NAME.json, its card.

The card says what the weights are for (``kind``, ``features``), the SHA-256 of their file, and how
they were trained. Nothing is ever executed by loading: safetensors holds numbers only.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load as parse
from torch import Tensor, nn

from coloc_env import options

SUFFIX = ".safetensors"


class Learned(nn.Module):
    """A neural part with checkpoints of its own ``kind``; ``features`` names what it is fed, in
    order, so that weights never meet inputs of another meaning."""

    kind: ClassVar[str]
    features: ClassVar[tuple[str, ...]]
    architecture: Mapping[str, Any] = {}


_L = TypeVar("_L", bound=Learned)


@contextmanager
def drawn_from(seed: int) -> Iterator[None]:
    """What torch draws inside comes from ``seed`` and leaves its shared generator as it was; new
    parameters are float32, whatever torch's default is."""
    default = torch.get_default_dtype()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        torch.set_default_dtype(torch.float32)
        try:
            yield
        finally:
            torch.set_default_dtype(default)


def untrained(kind: type[_L], seed: int, **architecture: Any) -> _L:
    """A neural part with random weights, drawn from ``seed`` and from no shared generator."""
    with drawn_from(seed):
        return kind(**architecture)


def learned(kind: type[_L], weights: str, seed: int = 0, **architecture: Any) -> _L:
    """A neural part with a checkpoint's weights (``load``) and the architecture of its card;
    untrained, with the one given, for ``none``."""
    if weights == "none":
        return untrained(kind, seed, **architecture)
    card = card_of(weights)
    own = card.get("architecture", {}) if card["kind"] == kind.kind else {}
    try:
        module = untrained(kind, seed, **{**architecture, **own})
    except TypeError:
        raise ValueError(
            f"{weights}: its card has an architecture that no {kind.kind} has"
        ) from None
    load(weights, module)
    return module


def card_of(source: str | Path) -> dict[str, Any]:
    """A checkpoint's card, without looking at its weights; ValueError as ``load`` raises it."""
    return _card(_find(source)[1])


def load(source: str | Path, module: Learned) -> dict[str, Any]:
    """Write a checkpoint's weights into ``module``, in place, and return its card.

    ``source``: the name of a shipped checkpoint (``pfnn``), or a path to a file. Raises ValueError,
    in one line that names the file and what is wrong with it, before anything is written.
    """
    weights, card_file = _find(source)
    card = _card(card_file)
    if card["kind"] != module.kind:
        raise ValueError(
            f"{weights} holds weights of kind {card['kind']!r}: {module.kind!r} is needed"
        )
    if card["features"] != list(module.features):
        raise ValueError(
            f"{weights} was trained on the features {', '.join(card['features'])}: "
            f"{', '.join(module.features)} are needed"
        )
    data = weights.read_bytes()
    if hashlib.sha256(data).hexdigest() != card["sha256"]:
        raise ValueError(
            f"{weights} is damaged, or {card_file.name} belongs to another file: "
            "their SHA-256 differ"
        )
    try:
        tensors = parse(data)
    except (SafetensorError, ValueError) as error:
        raise ValueError(f"{weights} is not a safetensors file: {error}") from None
    _check(str(weights), tensors, module.state_dict())
    module.load_state_dict(tensors)
    return card


def shipped() -> list[str]:
    """Names of the checkpoints that come with the package."""
    names = (entry.name for entry in resources.files("checkpoints").iterdir())
    return sorted(name.removesuffix(SUFFIX) for name in names if name.endswith(SUFFIX))


def _find(source: str | Path) -> tuple[Traversable, Traversable]:
    """A checkpoint's two files."""
    text = str(source)
    folder: Traversable
    if isinstance(source, str) and Path(text).name == text and not text.endswith(SUFFIX):
        if text not in shipped():
            raise ValueError(
                f"{options.unknown('checkpoint', text, shipped())}; "
                f"a file of your own is named by its path, ./{text}{SUFFIX}"
            )
        folder, name = resources.files("checkpoints"), text
    else:
        folder, name = Path(text).parent, Path(text).name.removesuffix(SUFFIX)
    weights, card = folder / f"{name}{SUFFIX}", folder / f"{name}.json"
    if not weights.is_file():
        raise ValueError(f"{weights}: no such file")
    if not card.is_file():
        raise ValueError(f"{weights} lacks its card {card.name}: a checkpoint is the pair of them")
    return weights, card


def _card(file: Traversable) -> dict[str, Any]:
    try:
        card = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file} is not JSON: {error}") from None
    needed = {"kind": str, "features": list, "sha256": str}
    for key, kind in needed.items():
        if not isinstance(card, dict) or not isinstance(card.get(key), kind):
            raise ValueError(f"{file} is no checkpoint's card: {', '.join(needed)} are needed")
    return card


def _check(name: str, found: Mapping[str, Tensor], needed: Mapping[str, Tensor]) -> None:
    """Raise ValueError unless tensors have the names, shapes and types needed, and are finite."""
    if found.keys() != needed.keys():
        raise ValueError(f"{name} holds {', '.join(sorted(found))}: {', '.join(needed)} are needed")
    for key, value in needed.items():
        got = found[key]
        if got.shape != value.shape or got.dtype != value.dtype:
            raise ValueError(f"{name}: {key} is {_describe(got)}, {_describe(value)} is needed")
        if not bool(torch.isfinite(got).all()):
            raise ValueError(f"{name}: {key} holds NaN or infinity")


def _describe(value: Tensor) -> str:
    return f"{str(value.dtype).removeprefix('torch.')} {list(value.shape)}"
