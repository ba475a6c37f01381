"""What policies have scored in the tasks: files of ``coloc score`` in ``agents/tasks/scores``."""

import json
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "scores"


def scores() -> dict[str, list[dict[str, Any]]]:
    """Stored scores by task, the best first."""
    found: dict[str, list[dict[str, Any]]] = {}
    for file in sorted(FOLDER.glob("*/*.json")):
        one = json.loads(file.read_text(encoding="utf-8"))
        found.setdefault(one["task"], []).append(one)
    for rows in found.values():
        rows.sort(key=lambda one: -one["return"])
    return found
