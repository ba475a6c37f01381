"""Atomic writing: all or nothing, whatever happens when."""

import os
from pathlib import Path

import pytest

from coloc_env.staging import staged_file, staged_folder

NAMES = ("table.md", "tum", "results.json")


def everything(folder: Path) -> dict[str, str]:
    return {
        str(p.relative_to(folder)): p.read_text() if p.is_file() else "" for p in folder.rglob("*")
    }


def fill(folder: Path, word: str, names: tuple[str, ...] = NAMES) -> None:
    for name in names:
        if name == "tum":
            (folder / "tum").mkdir()
            (folder / "tum" / "uav_0.txt").write_text(word)
        else:
            (folder / name).write_text(word)


def write(out: Path, error: type[BaseException]) -> None:
    with staged_folder(out, NAMES) as folder:
        fill(folder, "new")
        raise error


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A folder of results with somebody's note in it."""
    out = tmp_path / "out"
    with staged_folder(out, NAMES) as folder:
        fill(folder, "old")
    (out / "note.txt").write_text("mine")
    return out


def test_a_new_folder_appears_at_the_end(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "er" / "out"
    with staged_folder(out, NAMES) as folder:
        fill(folder, "new")
        assert not out.exists()
    assert everything(tmp_path / "deep" / "er") == {
        "out": "",
        "out/table.md": "new",
        "out/tum": "",
        "out/tum/uav_0.txt": "new",
        "out/results.json": "new",
    }


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_failure_leaves_nothing(tmp_path: Path, error: type[BaseException]) -> None:
    with pytest.raises(error):
        write(tmp_path / "deep" / "er" / "out", error)
    assert everything(tmp_path) == {}


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_failure_leaves_old_results(old: Path, error: type[BaseException]) -> None:
    before = everything(old.parent)
    with pytest.raises(error):
        write(old, error)
    assert everything(old.parent) == before


@pytest.mark.parametrize("call", range(1, 7))
def test_a_failure_while_replacing_leaves_old_results(
    old: Path, call: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, real, calls = everything(old.parent), os.replace, iter(range(1, 100))

    def replace(source: Path, target: Path) -> None:
        if next(calls) == call:
            raise KeyboardInterrupt
        real(source, target)

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(KeyboardInterrupt), staged_folder(old, NAMES) as folder:
        fill(folder, "new")
    assert everything(old.parent) == before


def test_old_results_are_replaced_whole_and_notes_stay(old: Path) -> None:
    with staged_folder(old, NAMES) as folder:
        fill(folder, "new", ("table.md", "results.json"))
    assert everything(old) == {"note.txt": "mine", "table.md": "new", "results.json": "new"}


def test_somebody_elses_files_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "table.md").write_text("mine")
    with (
        pytest.raises(ValueError, match=r"'table.md' but no results.json"),
        staged_folder(tmp_path, NAMES),
    ):
        pytest.fail("begun")
    assert everything(tmp_path) == {"table.md": "mine"}


def test_what_cannot_be_written_is_said_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for out, words in (
        (tmp_path / "file", "is not a folder"),
        (tmp_path / "file" / "out", "file is not a folder"),
        (tmp_path / "file" / "deep" / "out", "cannot be written"),
    ):
        with pytest.raises(ValueError, match=words), staged_folder(out, NAMES):
            pytest.fail("begun")
    assert everything(tmp_path) == {"file": "mine"}


def test_read_only_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write anywhere
    with (
        pytest.raises(ValueError, match="cannot be written: permission denied"),
        staged_folder(tmp_path / "out", NAMES),
    ):
        pytest.fail("begun")


def test_files(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "a.gif"

    def interrupted() -> None:
        with staged_file(out) as file:
            file.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert everything(tmp_path) == {}
    for word in ("old", "new"):
        with staged_file(out) as file:
            assert file.suffix == ".gif"
            file.write_text(word)
        assert everything(tmp_path) == {"deep": "", "deep/a.gif": word}
    with pytest.raises(ValueError, match="is a folder"), staged_file(tmp_path):
        pytest.fail("begun")
