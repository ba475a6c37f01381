"""Writing weights and their card, for ``agents.weights`` to read."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors.torch import save

from agents.weights import Learned
from coloc_env.staging import staged_file


def write(weights: Path, module: Learned, trained: Mapping[str, Any]) -> None:
    """Write ``weights`` (NAME.safetensors) and its card NAME.json.

    ``trained``: what the card says of how the weights came to be. Both files are complete before
    either gets its name; should only one get it, the hashes differ and loading says so.
    """
    data = save({name: value.contiguous() for name, value in module.state_dict().items()})
    card = {
        "kind": module.kind,
        "features": list(module.features),
        **({"architecture": module.architecture} if module.architecture else {}),
        "sha256": hashlib.sha256(data).hexdigest(),
        **trained,
    }
    text = json.dumps(card, indent=2, ensure_ascii=False) + "\n"
    with staged_file(weights) as first, staged_file(weights.with_suffix(".json")) as second:
        first.write_bytes(data)
        second.write_text(text, encoding="utf-8")
