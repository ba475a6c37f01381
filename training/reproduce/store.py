"""What has been computed so far, a file a piece: whatever stops the work, what is done stays done.

A piece is known by everything that it depends on; that decides its file's name and stands in the
file too. So pieces of other settings, other code or other weights are never taken for one another.
"""

import hashlib
import json
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from coloc_env.staging import staged_file

Arrays = dict[str, np.ndarray]
_FACTS = "facts.json"


class Store:
    """Arrays and plain facts in a folder, under readable names and everything they depend on."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, name: str, settings: Mapping[str, Any]) -> Path:
        """Where a piece lies, or will: ``name``, of which ``/`` makes folders, and a hash."""
        digest = hashlib.sha256(_canonical(settings).encode()).hexdigest()[:12]
        plain = re.sub(r"[^\w./=,+-]+", "_", name)
        return self.folder / f"{plain}-{digest}.npz"

    def has(self, name: str, settings: Mapping[str, Any]) -> bool:
        """Whether a piece has been computed with exactly these settings."""
        return self.path(name, settings).is_file()

    def save(
        self, name: str, settings: Mapping[str, Any], arrays: Arrays, facts: Mapping[str, Any]
    ) -> None:
        """Write a piece at once or not at all; ``facts`` are what JSON can say."""
        text = json.dumps({"settings": settings, "facts": facts})
        content = {_FACTS: np.frombuffer(text.encode(), np.uint8), **arrays}
        with staged_file(self.path(name, settings)) as file:
            np.savez_compressed(file, **content)  # type: ignore[arg-type]

    def load(self, name: str, settings: Mapping[str, Any]) -> tuple[Arrays, dict[str, Any]]:
        """A piece's arrays and facts. ValueError if the file is damaged, or was made with other
        settings than its name says."""
        path = self.path(name, settings)
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {key: file[key] for key in file.files}
            told = json.loads(arrays.pop(_FACTS).tobytes())
        except (zipfile.BadZipFile, EOFError, KeyError, ValueError) as error:
            raise ValueError(f"{path} is damaged ({error}); remove it to compute it anew") from None
        if _canonical(told["settings"]) != _canonical(settings):
            raise ValueError(f"{path} was made with other settings; remove it to compute it anew")
        return arrays, told["facts"]


def _canonical(settings: Mapping[str, Any]) -> str:
    return json.dumps(settings, sort_keys=True, allow_nan=False)
