"""What a result depends on beside its settings: the code that made it, and learned weights.

The code is that of the agents, of the scenario's family and its worlds, and of everything of this
project that those import; comments and docstrings do not count. Registries name modules and import
none, so the family and the localizers are looked up.
"""

import ast
import hashlib
import importlib.util
import inspect
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import torch
from torch import nn

from agents.localizer import Localizer
from agents.parts import parts_of
from coloc_env.scenarios.registry import SCENARIOS

_PACKAGES = ("agents", "coloc_env", "training")
_ONLY_REGISTER = ("agents", "coloc_env")  # to import these is to depend on nothing in them
_WORLD = ("coloc_env.world", "coloc_env.bounds", "training.evaluation.rollout")


def code_of(
    scenario: str, localizers: Iterable[Localizer] = (), modules: Iterable[str] = ()
) -> str:
    """Hash of the code of a scenario's family (by the scenario's id), of worlds, of localizers with
    the localizers that they are made of, and of other modules."""
    family = inspect.getsourcefile(inspect.unwrap(SCENARIOS[scenario]))
    parts = {type(part) for one in localizers for part in parts_of(one)}
    made_of = [part for part in parts if issubclass(part, Localizer)]
    sources = sorted(filter(None, (family, *map(inspect.getsourcefile, made_of))))
    first = [file for name in (*_WORLD, *modules) for file in _files(name)]
    return _closure((*first, *map(Path, sources)))


def weights_of(localizer: Localizer) -> str | None:
    """Hash of a localizer's learned weights, wherever in its parts; None if it has none."""
    digest, some = hashlib.sha256(), False
    for module in parts_of(localizer):
        if not isinstance(module, nn.Module):
            continue
        for key, value in module.state_dict().items():
            some = True
            digest.update(f"{key}{tuple(value.shape)}".encode())
            digest.update(value.detach().to("cpu", torch.float64).numpy().tobytes())
    return digest.hexdigest()[:12] if some else None


@cache
def _closure(first: tuple[Path, ...]) -> str:
    """Hash of files and of what they import, whatever the order."""
    found: dict[Path, str] = {}
    left = list(first)
    while left:
        path = left.pop()
        if path not in found:
            found[path], imports = _read(path)
            left += imports
    return _hash("\n".join(sorted(found.values())))[:12]


@cache
def _read(path: Path) -> tuple[str, tuple[Path, ...]]:
    """Hash of a file's code without its docstrings, and the project's files that it imports."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    imports = tuple(file for name in _imported(tree) for file in _files(name))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                node.body = node.body[1:]
    return _hash(ast.dump(tree)), imports


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _imported(tree: ast.AST) -> Iterator[str]:
    """Names that may be modules: ``a.b`` and, of ``from a import b``, both ``a`` and ``a.b``. What
    only type checkers import is left out."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        else:
            yield from _imported(node)


@cache
def _files(name: str) -> tuple[Path, ...]:
    """The file of a module of this project; none for anything else. Imports nothing."""
    package, *rest = name.split(".")
    if package not in _PACKAGES or name in _ONLY_REGISTER:
        return ()
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        return ()
    path = Path(spec.origin).parent.joinpath(*rest)
    return tuple(p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file())
