"""The ``coloc`` command's door: checks that ``agents`` and ``training`` are coloc's own.

Both names are common: openai-agents, among others, installs a package ``agents``. Whoever shares an
environment with such a package says so in one line, instead of an ImportError from deep inside.
"""

import importlib
import importlib.util
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

_MARKERS = {"agents": "registry.py", "training": "cli/command.py"}  # a file beside __init__.py
_SIGN = "coloc"  # stands in the docstring of their __init__.py
_DISTRIBUTION = "coloc-env"


def require_own_packages() -> None:
    """Raise ImportError, in one line, where another distribution's package answers to the name
    ``agents`` or ``training``."""
    for name, marker in _MARKERS.items():
        spec = importlib.util.find_spec(name)
        if spec is None:
            raise ImportError(f"{_DISTRIBUTION} is not installed whole: {name} is missing")
        places = [Path(place) for place in spec.submodule_search_locations or ()]
        if not any(_is_own(place, marker) for place in places):
            where = spec.origin or ", ".join(map(str, places)) or "an unknown place"
            raise ImportError(
                f"the package {name!r} at {where}{_owners(name)} hides that of {_DISTRIBUTION}: "
                f"install {_DISTRIBUTION} into an environment of its own (python -m venv)"
            )


def _is_own(folder: Path, marker: str) -> bool:
    """Whether a package's folder is ours: installed on top of ours, another's has our modules but
    an ``__init__.py`` of its own."""
    init = folder / "__init__.py"
    return (folder / marker).is_file() and init.is_file() and _SIGN in init.read_text("utf-8")


def _owners(name: str) -> str:
    """The other distributions that install a package of this name, in brackets."""
    others = sorted({*packages_distributions().get(name, ())} - {_DISTRIBUTION})
    return f" (of {', '.join(others)})" if others else ""


def main() -> None:
    """Run the ``coloc`` command. Exit code 2 where another's package has taken a name of ours."""
    try:
        require_own_packages()
    except ImportError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    importlib.import_module("training.cli.command").main()
