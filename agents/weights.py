"""Checkpoints: the weights of learned parts, NAME.safetensors beside NAME.json, its card.

The card holds what the weights are for (``kind``, ``features``), the SHA-256 of their file, and how
they were trained. Nothing is ever executed by loading: safetensors holds numbers only.
"""

import hashlib
import json
import math
import typing
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load as parse
from safetensors.torch import save as serialized
from torch import Tensor, nn

from coloc_env import options
from coloc_env.json_files import read_json
from coloc_env.options import PositiveCount
from coloc_env.staging import staged_file

SUFFIX = ".safetensors"
_NEEDED = {"kind": str, "features": tuple[str, ...], "sha256": str}
_OPTIONAL = {
    "architecture": dict,
    "command": str,
    "training": str,
    "options": dict,
    "epochs": PositiveCount,
    "frames": PositiveCount,
    "versions": dict[str, str],
    "metrics": dict[str, float | None],
    "scores": dict,
}
_LARGEST = 10_000  # whole number in an architecture: beyond, it would fill the memory


class Learned(nn.Module):
    """A neural part with checkpoints of its own ``kind``; ``features`` names what it is fed, in
    order, so that weights never meet inputs of another meaning."""

    kind: ClassVar[str]
    features: tuple[str, ...]
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


def learned(kind: type[_L], weights: str | Path, seed: int = 0, **architecture: Any) -> _L:
    """A neural part with a checkpoint's weights (``load``) and the architecture of its card;
    untrained, with the one given, for ``none``."""
    if weights == "none":
        return untrained(kind, seed, **architecture)
    file, card, tensors = _read(weights, kind)
    own = card.get("architecture", {})
    _check_architecture(f"{file}: its card", kind, own)
    unlike = f"{file}: its card has an architecture that no {kind.kind} has"
    try:
        module = untrained(kind, seed, **{**architecture, **own})
    except (ArithmeticError, LookupError, AttributeError, TypeError, ValueError, RuntimeError):
        raise ValueError(unlike) from None
    missing = sorted(module.architecture.keys() - own.keys())
    if missing:
        raise ValueError(f"{unlike}: {', '.join(missing)} missing")
    _fill(module, file, card, tensors)
    return module


def load(source: str | Path, module: Learned) -> dict[str, Any]:
    """Write a checkpoint's weights into ``module``, in place, and return its card.

    ``source``: the name of a shipped checkpoint (``pfnn``), or a path to a file. Raises ValueError,
    in one line that names the file and what is wrong with it, before anything is written.
    """
    file, card, tensors = _read(source, type(module))
    _fill(module, file, card, tensors)
    return card


def card_of(source: str | Path) -> dict[str, Any]:
    """A checkpoint's card, without looking at its weights; ValueError as ``load`` raises it."""
    return _card(_find(source)[1])


def write(weights: Path, module: Learned, trained: Mapping[str, Any]) -> None:
    """Write ``weights`` (NAME.safetensors) and its card NAME.json.

    ``trained``: what the card records of the training; a number that is NaN or infinite
    becomes null. Both files are complete before
    either gets its name; should only one get it, the hashes differ and loading refuses them.
    """
    data = serialized({name: value.contiguous() for name, value in module.state_dict().items()})
    card = {
        "kind": module.kind,
        "features": list(module.features),
        **({"architecture": module.architecture} if module.architecture else {}),
        "sha256": hashlib.sha256(data).hexdigest(),
        **trained,
    }
    text = json.dumps(_finite(card), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    with staged_file(weights.with_suffix(".json")) as second, staged_file(weights) as first:
        first.write_bytes(data)
        second.write_text(text, encoding="utf-8")


def shipped() -> list[str]:
    """Names of the checkpoints that come with the package."""
    names = (entry.name for entry in resources.files("checkpoints").iterdir())
    return sorted(name.removesuffix(SUFFIX) for name in names if name.endswith(SUFFIX))


# ------------------------------------------------------------------ reading


def _find(source: str | Path) -> tuple[Traversable, Traversable]:
    """A checkpoint's two files; ``~`` is the home directory."""
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
        try:
            path = Path(text).expanduser()
        except RuntimeError:
            raise ValueError(f"{text}: there is no such home directory") from None
        folder, name = path.parent, path.name.removesuffix(SUFFIX)
    weights, card = folder / f"{name}{SUFFIX}", folder / f"{name}.json"
    if not weights.is_file():
        raise ValueError(f"{weights}: no such file")
    if not card.is_file():
        raise ValueError(f"{weights} lacks its card {card.name}: a checkpoint is the pair of them")
    return weights, card


def _card(file: Traversable) -> dict[str, Any]:
    return read_json(file, "a checkpoint's card", _NEEDED, _OPTIONAL)


def _read(
    source: str | Path, kind: type[Learned]
) -> tuple[Traversable, dict[str, Any], dict[str, Tensor]]:
    """The file, the card and the tensors of a checkpoint of this kind; ValueError if the two files
    are not a checkpoint's, or do not belong together."""
    weights, file = _find(source)
    card = _card(file)
    if card["kind"] != kind.kind:
        raise ValueError(
            f"{weights} holds weights of kind {card['kind']!r}: {kind.kind!r} is needed"
        )
    data = weights.read_bytes()
    if hashlib.sha256(data).hexdigest() != card["sha256"]:
        raise ValueError(
            f"{weights} is damaged, or {file.name} belongs to another file: their SHA-256 differ"
        )
    try:
        return weights, card, parse(data)
    except (SafetensorError, ValueError) as error:
        raise ValueError(f"{weights} is not a safetensors file: {error}") from None


def _check_architecture(owner: str, kind: type[Learned], given: Mapping[str, Any]) -> None:
    """Raise ValueError unless an architecture has the parameters of the kind, of their types, and
    no number that would fill the memory."""
    hints = typing.get_type_hints(kind.__init__)
    for key, value in given.items():
        if key not in hints:
            raise ValueError(f"{owner} has an architecture that no {kind.kind} has: {key!r}")
        hint = typing.get_origin(hints[key]) or hints[key]
        right = isinstance(value, dict) if hint is Mapping else options.fits(value, hint)
        if not right or any(number > _LARGEST for number in _numbers(value)):
            raise ValueError(
                f"{owner} has an architecture that no {kind.kind} has: {key}={value!r:.60}"
            )


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, Mapping):
        for each in value.values():
            yield from _numbers(each)
    elif isinstance(value, int | float):
        yield value


def _fill(
    module: Learned, file: Traversable, card: Mapping[str, Any], found: Mapping[str, Tensor]
) -> None:
    """Write tensors into a module; ValueError unless they were trained on its features and have the
    names, shapes and types that it needs, and are finite."""
    if card["features"] != list(module.features):
        raise ValueError(
            f"{file} was trained on the features {_list(card['features'])}: "
            f"{_list(module.features)} are needed"
        )
    needed = module.state_dict()
    if found.keys() != needed.keys():
        raise ValueError(f"{file} holds {_list(sorted(found))}: {_list(needed)} are needed")
    for key, value in needed.items():
        got = found[key]
        if got.shape != value.shape or got.dtype != value.dtype:
            raise ValueError(f"{file}: {key} is {_describe(got)}, {_describe(value)} is needed")
        if not bool(torch.isfinite(got).all()):
            raise ValueError(f"{file}: {key} holds NaN or infinity")
    module.load_state_dict(dict(found))


def _finite(value: Any) -> Any:
    """What JSON can hold of a value."""
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _list(names: Iterable[str]) -> str:
    """Names in one line."""
    return ", ".join(" ".join(name.split()) for name in names)


def _describe(value: Tensor) -> str:
    return f"{str(value.dtype).removeprefix('torch.')} {list(value.shape)}"
