"""The resumable state of a training or of a running localizer: everything that it needs to go on,
in one file, without pickle.

Tensors are kept by safetensors; all else is JSON in that file's header, beside a SHA-256 of both.
One file, renamed into place, is either the old state or the new one, whenever the process dies.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialized
from torch import Tensor

from coloc_env.staging import staged_file


def save(file: Path, state: Mapping[str, Any]) -> None:
    """Write a state: nested dictionaries and lists of tensors, numbers, texts and None."""
    tensors: dict[str, Tensor] = {}
    tree = json.dumps(_pack(state, tensors))
    data = serialized(tensors, {"tree": tree, "sha256": _sha256(tree, tensors)})
    with staged_file(file) as staged:
        staged.write_bytes(data)


def load(file: Path) -> dict[str, Any]:
    """The state that ``save`` wrote, every bit of it; tuples come back as lists. Raises ValueError
    if it has changed since, or has no checksum, as those of coloc 0.1 had none; OSError if it
    cannot be read."""
    try:
        with safe_open(file, "pt") as opened:
            header = opened.metadata() or {}
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    except (SafetensorError, TypeError, ValueError) as error:
        raise ValueError(f"{file} is damaged: {type(error).__name__}: {error}") from None
    if "tree" not in header or "sha256" not in header:
        raise ValueError(f"{file} has no checksum: an older coloc wrote it, or it is damaged")
    if _sha256(header["tree"], tensors) != header["sha256"]:
        raise ValueError(f"{file} is damaged: its SHA-256 differs from what was written")
    return _unpack(json.loads(header["tree"]), tensors)


def _sha256(tree: str, tensors: Mapping[str, Tensor]) -> str:
    """Of all that a state is, whichever the order of its header's entries."""
    return hashlib.sha256(serialized(dict(tensors), {"tree": tree})).hexdigest()


def _pack(value: Any, tensors: dict[str, Tensor]) -> Any:
    """``value`` as JSON can hold it (keys that are not texts included), tensors by number."""
    if isinstance(value, Tensor):
        name = str(len(tensors))
        tensors[name] = value.detach().cpu().clone().contiguous()
        return {"tensor": name}
    if isinstance(value, Mapping):
        return {"items": [[key, _pack(item, tensors)] for key, item in value.items()]}
    if isinstance(value, (list, tuple)):
        return [_pack(item, tensors) for item in value]
    return value


def _unpack(packed: Any, tensors: Mapping[str, Tensor]) -> Any:
    if isinstance(packed, list):
        return [_unpack(item, tensors) for item in packed]
    if isinstance(packed, dict):
        if "tensor" in packed:
            return tensors[packed["tensor"]]
        return {key: _unpack(item, tensors) for key, item in packed["items"]}
    return packed
