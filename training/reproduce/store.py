"""The store: a file for every piece that has been computed, so that no work is lost or mixed up.

A piece is known by everything that it depends on; that decides its file's name and stands in the
file too. A file is a NumPy archive followed by its SHA-256: it is read only if that fits, so that
a damaged file is never taken for a result.
"""

import hashlib
import io
import json
import re
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from coloc_env.staging import staged_file

Arrays = dict[str, np.ndarray]
Facts = dict[str, Any]
_FACTS = "facts.json"
_UNREADABLE = (EOFError, NotImplementedError, AttributeError, zipfile.BadZipFile, zlib.error)
_DIGEST = hashlib.sha256().digest_size  # bytes


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
        """Whether a piece has been computed with exactly these settings, and is not damaged."""
        path = self.path(name, settings)
        return path.is_file() and _archive(path) is not None

    def save(
        self, name: str, settings: Mapping[str, Any], arrays: Arrays, facts: Mapping[str, Any]
    ) -> None:
        """Write a piece at once or not at all; ``facts``: what JSON can hold."""
        text = json.dumps({"settings": settings, "facts": facts})
        archive = io.BytesIO()
        content = {_FACTS: np.frombuffer(text.encode(), np.uint8), **arrays}
        np.savez_compressed(archive, **content)  # type: ignore[arg-type]
        with staged_file(self.path(name, settings)) as file:
            file.write_bytes(archive.getvalue() + hashlib.sha256(archive.getvalue()).digest())

    def load(self, name: str, settings: Mapping[str, Any]) -> tuple[Arrays, Facts]:
        """A piece's arrays and facts. ValueError if the file is damaged, or was made with other
        settings than its name says."""
        path = self.path(name, settings)
        archive = _archive(path)
        if archive is None:
            raise ValueError(f"{path} is damaged: run the command again to compute it again")
        try:
            with np.load(io.BytesIO(archive), allow_pickle=False) as file:
                arrays = {key: file[key] for key in file.files}
            content = json.loads(arrays.pop(_FACTS).tobytes())
            made, facts = content["settings"], content["facts"]
        except (*_UNREADABLE, ValueError, LookupError, TypeError):
            raise ValueError(f"{path} is no file of a store: remove it") from None
        if _canonical(made) != _canonical(settings):
            raise ValueError(f"{path} was made with other settings: remove it")
        return arrays, facts

    def empty(self) -> bool:
        """Whether nothing is stored."""
        return next(self.folder.rglob("*.npz"), None) is None


def _archive(path: Path) -> bytes | None:
    """A file's archive; None if its checksum does not fit."""
    content = path.read_bytes()
    archive, digest = content[:-_DIGEST], content[-_DIGEST:]
    return archive if hashlib.sha256(archive).digest() == digest else None


def _canonical(settings: Mapping[str, Any]) -> str:
    return json.dumps(settings, sort_keys=True, allow_nan=False)
