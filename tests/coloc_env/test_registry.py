"""Packages of somebody's own that are broken: one line says what is wrong, and with whose; what is
built in works all the same."""

from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

from agents import LOCALIZERS, Localizer, make
from coloc_env import registry
from coloc_env.registry import Registry
from coloc_env.scenarios import SCENARIOS, make_scenario

BROKEN = {
    "def f(:\n": "SyntaxError: invalid syntax",
    "raise RuntimeError('first\\nsecond')\n": "RuntimeError: first second",
    "import sys\nsys.exit(3)\n": "SystemExit: 3",
    "import no_such_module_at_all\n": "No module named 'no_such_module_at_all'",
    "x = 1\n": "has no attribute 'made'",
    "made = 3\n": "a function or class is needed, not 3",
}


def registry_of(monkeypatch: pytest.MonkeyPatch, *points: tuple[str, str]) -> Registry:
    """A registry with one built-in, and entry points: names and values."""
    found = [EntryPoint(name, value, "coloc.things") for name, value in points]
    monkeypatch.setattr(registry, "_points", lambda group: found)
    return Registry("thing", "coloc.things", {"built_in": "coloc_env.options:describe"})


@pytest.fixture
def module(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[str, Path]:
    """A new module's name and file, on the path."""
    monkeypatch.syspath_prepend(tmp_path)
    name = f"own_{abs(hash(request.node.name))}"
    return name, tmp_path / f"{name}.py"


@pytest.mark.parametrize("source", BROKEN)
def test_a_broken_package_is_named_in_one_line(
    source: str, module: tuple[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    name, file = module
    file.write_text(source)
    things = registry_of(monkeypatch, ("broken", f"{name}:made"))
    with pytest.raises(ValueError, match=f"thing 'broken' \\({name}:made\\)") as caught:
        things["broken"]
    assert BROKEN[source] in str(caught.value)
    assert "\n" not in str(caught.value)
    assert things.summary("built_in") == "A type in a user's words."
    assert "\n" not in things.summary("broken")


def test_lists_say_what_cannot_be_read(
    module: tuple[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    name, file = module
    file.write_bytes(b"# \xe9\xff\nmade = 3\n")
    things = registry_of(
        monkeypatch, ("latin", f"{name}:made"), ("gone", "no_such_module_at_all:x")
    )
    assert things.summary("latin").startswith(f"({name}: SyntaxError: ")
    assert things.summary("gone") == "(no_such_module_at_all: FileNotFoundError: no such module)"


def test_nested_attributes_and_extras_are_those_of_entry_points(
    module: tuple[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    name, file = module
    file.write_text("class Home:\n    @staticmethod\n    def made(*, size: int = 3): 'Made.'\n")
    things = registry_of(monkeypatch, ("nested", f"{name}:Home.made [more]"))
    assert list(things.options_of("nested")) == ["size"]
    assert things.summary("nested") == "Made."


def test_options_that_cannot_be_read_are_one_line(
    module: tuple[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    name, file = module
    file.write_text("def made(*, size: 'Unknown' = 3): ...\n")
    things = registry_of(monkeypatch, ("odd", f"{name}:made"))
    with pytest.raises(ValueError, match="'odd': its options cannot be read: NameError"):
        things.options_of("odd")


def test_a_name_taken_twice_is_said_when_something_is_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    things = registry_of(monkeypatch, ("built_in", "somewhere:other"))
    assert things.names() == ["built_in"]  # what `import coloc_env` registers with PettingZoo
    with pytest.raises(ValueError, match="somewhere brings the thing 'built_in', which exists"):
        things["built_in"]


def test_what_makes_something_else_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Abstract(Localizer[Any]):
        """Lacks reset and step."""

    class Nothing:
        """Takes no beliefs."""

    monkeypatch.setitem(SCENARIOS._registered, "none-v0", lambda: None)
    with pytest.raises(ValueError, match="none-v0: a Scenario is needed, not NoneType"):
        make_scenario("none-v0")
    scenario = make_scenario("indoor-v0", n_uavs=2)
    refusals = {
        Nothing: "own: a Localizer is made of a team's beliefs and its own options",
        Abstract: "own: Abstract lacks what a Localizer has: reset, step",
        lambda believed: 3: "own: a Localizer is needed, not int",
    }
    for factory, words in refusals.items():
        monkeypatch.setitem(LOCALIZERS._registered, "own", factory)
        with pytest.raises(ValueError, match=words):
            make("own", scenario)


def test_a_broken_localizer_spoils_no_other_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LOCALIZERS._references, "broken", "no_such_module_at_all:x")
    with pytest.raises(ValueError, match="would be ignored; these use it: apf") as caught:
        make("map", make_scenario("indoor-v0", n_uavs=2))
    assert "broken" not in str(caught.value)
