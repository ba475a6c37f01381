"""The page "Where is the equation?", written from the docstrings and comments of the agents."""

import ast
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

_ROOT = Path(__file__).parents[2]
_NUMBERED = re.compile(r"\b(?:[Ee]quations?|eqs?\.)\s+(\d+(?:(?: to | and |–|-|, )\d+)*)")
_PAPERS = {  # what implements each paper
    "PF-NN": (
        "agents/particle/apf.py",
        "agents/particle/corrector.py",
        "agents/particle/likelihood.py",
        "agents/particle/particle_count.py",
        "agents/particle/pfnn.py",
    ),
    "NN-HPFF": (
        "agents/kalman/emvf.py",
        "agents/particle/failure.py",
        "agents/particle/hpff.py",
        "agents/particle/hybrid.py",
        "agents/particle/nnhpff.py",
    ),
    "ST-DCL": ("agents/swarm", "agents/stdcl", "training/reproduce/stdcl/theory.py"),
    "CSPF": ("agents/stein",),
}


_MODULE = "the module"


def on_files(files: Files, config: Any, **_: Any) -> Files:
    files.append(File.generated(config, "explanation/equations.md", content=page()))
    return files


def page() -> str:
    text = [
        "# Where is the equation?\n",
        "Docstrings and comments name the equations of the papers. This list is written from them: "
        "equation, file, and the class or function that computes it.\n",
    ]
    for paper, places in _PAPERS.items():
        rows = sorted({row for place in places for row in _rows(_ROOT / place)})
        named = {row[:3] for row in rows if row[3] != _MODULE}
        rows = [row for row in rows if row[3] != _MODULE or row[:3] not in named]
        text += [f"## {paper}\n"]
        lines = [f"| {numbers} | `{where}` | `{name}` |" for _, numbers, where, name in rows]
        header = ["| equation | file | in |", "| --- | --- | --- |"]
        text += ["\n".join(header + lines) + "\n"] if rows else [_whole(places)]
    return "\n".join(text)


def _whole(places: Iterable[str]) -> str:
    return "Its equations have no numbers. The files: " + ", ".join(f"`{p}`" for p in places) + "\n"


def _rows(place: Path) -> list[tuple[int, str, str, str]]:
    """(first number, numbers, file, class or function) of each mention below a path."""
    found = []
    for file in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
        source = file.read_text(encoding="utf-8")
        owners = _owners(ast.parse(source))
        for match in _NUMBERED.finditer(source):
            line = source.count("\n", 0, match.start()) + 1
            inside = [name for first, last, name in owners if first <= line <= last]
            name = inside[-1] if inside else _MODULE
            first = int(re.match(r"\d+", match[1])[0])  # type: ignore[index]
            found.append((first, match[1], file.relative_to(_ROOT).as_posix(), name))
    return found


def _owners(tree: ast.Module) -> list[tuple[int, int, str]]:
    """Lines of each class and function, outer ones first."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.append((node.lineno, node.end_lineno or node.lineno, node.name))
    return sorted(found, key=lambda span: (span[0], -span[1]))
