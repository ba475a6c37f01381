"""Save points: everything a training needs to go on, in one file, without pickle.

Tensors are kept by safetensors; all else is JSON in that file's header. One file, renamed into
place, is either the old save point or the new one, whenever the process dies.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from coloc_env.staging import staged_file


def save(file: Path, state: Mapping[str, Any]) -> None:
    """Write a state: nested dictionaries and lists of tensors, numbers, texts and None."""
    tensors: dict[str, Tensor] = {}
    tree = json.dumps(_pack(state, tensors))
    with staged_file(file) as staged:
        save_file(tensors, staged, {"tree": tree})


def load(file: Path) -> dict[str, Any]:
    """The state that ``save`` wrote, every bit of it; tuples come back as lists."""
    try:
        with safe_open(file, "pt") as opened:
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
            tree = json.loads(opened.metadata()["tree"])
        return _unpack(tree, tensors)
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file} is damaged: {type(error).__name__}: {error}") from None


def _pack(value: Any, tensors: dict[str, Tensor]) -> Any:
    """``value`` as JSON can hold it (keys that are not texts included), tensors by number."""
    if isinstance(value, Tensor):
        name = str(len(tensors))
        tensors[name] = value.detach().clone().contiguous()
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
