"""Code shown in the README and on the site: Python runs, command lines are what the command takes.

Blocks of a page belong together: they run one after the other, as one script. A block that shows a
file (``--8<--``) is tested where that file is.
"""

import os
import re
import shlex
import subprocess
import sys
from itertools import takewhile
from pathlib import Path
from typing import Any

import pytest
import typer.main

from agents import LOCALIZERS
from coloc_env import SCENARIOS, options
from coloc_env.registry import Registry
from coloc_env.scenarios import parse_overrides
from training.cli.command import app
from training.learning.registry import TRAININGS
from training.reproduce.study import STUDIES

ROOT = Path(__file__).parents[2]
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("docs/tutorials/*.py")]
FENCE = re.compile(r"^```(?P<kind>\w+)[^\n]*\n(?P<code>.*?)^```", re.MULTILINE | re.DOTALL)
INCLUDED = re.compile(r'--8<-- "([^":]+)')
EXAMPLE = {
    "beacon-room-v0",
    "corridor-v0",
    "anchor_mean",
}  # of tests/example_package: tests/test_plugins.py
SHELL = ("<", ">", "|")  # what follows is the shell's, not the command's
COMMAND: Any = typer.main.get_command(app)


def blocks(page: Path, kind: str) -> list[str]:
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".py":
        text = re.sub(r"^# ?", "", text, flags=re.MULTILINE)
    return [found["code"] for found in FENCE.finditer(text) if found["kind"] == kind]


def shown(page: Path) -> str:
    return str(page.relative_to(ROOT))


def scripts() -> list[Path]:
    return [page for page in PAGES if page.suffix == ".md" and own_python(page)]


def own_python(page: Path) -> list[str]:
    return [code for code in blocks(page, "python") if "--8<--" not in code]


def lines() -> list[tuple[str, str]]:
    found = []
    for page in PAGES:
        for code in blocks(page, "bash"):
            joined = code.replace("\\\n", " ")
            found += [(shown(page), one) for one in joined.splitlines() if one.startswith("coloc ")]
    return list(dict.fromkeys(found))


def test_there_is_something_to_test() -> None:
    assert len(scripts()) >= 5
    assert len(lines()) >= 20


@pytest.mark.slow
@pytest.mark.parametrize("page", scripts(), ids=shown)
def test_python_runs(page: Path, tmp_path: Path) -> None:
    script = tmp_path / "page.py"
    script.write_text("\n".join(own_python(page)), encoding="utf-8")
    environ = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    line = [sys.executable, str(script)]
    done = subprocess.run(line, cwd=tmp_path, env=environ, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", [p for p in PAGES if "--8<--" in p.read_text()], ids=shown)
def test_files_that_are_shown_exist(page: Path) -> None:
    for name in INCLUDED.findall(page.read_text(encoding="utf-8")):
        assert (ROOT / name).is_file(), name


@pytest.mark.parametrize(("page", "line"), lines())
def test_command_lines_are_valid(page: str, line: str) -> None:
    """Parsed as the command parses them; what they name exists, with values that fit."""
    words = shlex.split(line, comments=True)
    _, name, *rest = takewhile(lambda word: word not in SHELL, words)
    if name.startswith("-"):
        assert name in ("--help", "--version")
        return
    given = COMMAND.commands[name].make_context(name, rest).params
    if scenario := given.get("scenario"):
        check(SCENARIOS, scenario)
    if name in ("scenarios", "agents") and given["name"]:
        check(SCENARIOS if name == "scenarios" else LOCALIZERS, given["name"])
    for agent in filter(None, (given.get("agents") or given.get("agent") or "").split(",")):
        check(LOCALIZERS, *agent.split(":"))
    if name == "train" and given["name"]:
        check(TRAININGS, given["name"], *given["settings"] or ())
    elif scenario and scenario not in EXAMPLE:
        parse_overrides(scenario, given.get("settings") or ())
    if name == "reproduce":
        check(STUDIES, given["study"])


def check(registry: Registry, name: str, *settings: str) -> None:
    if name in EXAMPLE:
        return
    known = registry.options_of(name)
    for setting in settings:
        options.parse(name, setting, known)
