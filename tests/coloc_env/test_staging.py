"""Atomic writing: all or nothing, whatever happens when."""

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from coloc_env.staging import locked, recover, staged_file, staged_folder

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
        pytest.fail("entered")
    assert everything(tmp_path) == {"table.md": "mine"}


def test_what_cannot_be_written_is_said_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for out, words in (
        (tmp_path / "file", "is not a folder"),
        (tmp_path / "file" / "out", "file is not a folder"),
        (tmp_path / "file" / "deep" / "out", "cannot be written"),
    ):
        with pytest.raises(ValueError, match=words), staged_folder(out, NAMES):
            pytest.fail("entered")
    assert everything(tmp_path) == {"file": "mine"}


def test_read_only_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write anywhere
    with (
        pytest.raises(ValueError, match="cannot be written: permission denied"),
        staged_folder(tmp_path / "out", NAMES),
    ):
        pytest.fail("entered")


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
        pytest.fail("entered")


# ---------------------------------------------------------------- killed, and power cuts

CALLS = ("rename", "replace", "fsync", "mkdir", "unlink", "rmdir")


def killed(work: Callable[[], object], call: int, after: bool) -> bool:
    """Whether a process of its own was killed (nothing is cleaned up) just before, or after, its
    so many-th call that changes what is on the disk."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
    count = 0

    def counted(real: Callable[..., object]) -> Callable[..., object]:
        def one(*args: object, **options: object) -> object:
            nonlocal count
            count += 1
            if count == call and not after:
                os._exit(9)
            mine = count == call
            try:
                return real(*args, **options)
            finally:
                if mine:
                    os._exit(9)

        return one

    try:
        for name in CALLS:
            setattr(os, name, counted(getattr(os, name)))
        work()
    finally:
        os._exit(0)


def write_new(out: Path) -> None:
    with staged_folder(out, NAMES) as folder:
        fill(folder, "new", ("tum", "results.json"))


def visible(folder: Path) -> dict[str, str]:
    return {name: text for name, text in everything(folder).items() if not name.startswith(".")}


OLD = {"note.txt": "mine", "table.md": "old", "tum": "", "tum/uav_0.txt": "old"}
OLD |= {"results.json": "old"}
NEW = {"note.txt": "mine", "tum": "", "tum/uav_0.txt": "new", "results.json": "new"}


@pytest.mark.slow
@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
def test_killed_at_every_call_while_results_are_replaced(tmp_path: Path, after: bool) -> None:
    """Whoever sees results.json sees the old or the new whole; after ``recover`` everybody does,
    and the next one that writes there leaves nothing hidden behind."""
    seen = []
    for call in range(1, 1000):
        out = tmp_path / str(call) / "out"
        with staged_folder(out, NAMES) as folder:
            fill(folder, "old")
        (out / "note.txt").write_text("mine")
        if not killed(lambda out=out: write_new(out), call, after):
            break
        if (out / "results.json").exists():
            assert visible(out) in (OLD, NEW)
        recover(out)
        assert visible(out) in (OLD, NEW)
        seen.append(visible(out) == NEW)
        write_new(out)
        assert everything(out) == NEW
    assert len(seen) > 20
    assert seen == sorted(seen)  # old up to some call, new from then on
    assert set(seen) == {False, True}


@pytest.mark.slow
def test_killed_while_the_recovery_is_at_work(tmp_path: Path) -> None:
    def interrupted_replacement(out: Path) -> None:
        """Killed with the marker gone and half of the rest moved."""
        for call in range(1, 1000):
            assert killed(lambda: write_new(out), call, True)
            if not (out / "results.json").exists() and not (out / "tum").exists():
                return

    for call in range(1, 1000):
        out = tmp_path / str(call) / "out"
        with staged_folder(out, NAMES) as folder:
            fill(folder, "old")
        (out / "note.txt").write_text("mine")
        interrupted_replacement(out)
        if not killed(lambda out=out: recover(out), call, True):
            break
        recover(out)
        assert visible(out) == NEW
    assert call > 3


@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
@pytest.mark.parametrize("was", ["", "old"])
def test_killed_at_every_call_of_a_file(tmp_path: Path, after: bool, was: str) -> None:
    def new() -> None:
        with staged_file(tmp_path / "a.json") as file:
            file.write_text("new")

    for call in range(1, 100):
        (tmp_path / "a.json").unlink(missing_ok=True)
        if was:
            (tmp_path / "a.json").write_text(was)
        if not killed(new, call, after):
            break
        assert visible(tmp_path) in ({"a.json": was} if was else {}, {"a.json": "new"})
    assert call > 3
    new()
    assert everything(tmp_path) == {"a.json": "new"}


def test_files_of_processes_that_live_are_left_alone(tmp_path: Path) -> None:
    other = f".a.partial-{os.getppid()}.json"
    strange = (".a.partial-1x.json", ".ab.partial-999999999.json", "a.partial-999999999.json")
    for name in (other, ".a.partial-999999999.json", f".a.partial-{10**30}.json", *strange):
        (tmp_path / name).write_text("half")
    with staged_file(tmp_path / "a.json") as file:
        file.write_text("new")
    assert everything(tmp_path).keys() == {"a.json", other, *strange}


def test_what_is_written_is_on_the_disk_before_it_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    def fsync(opened: int) -> None:
        done.append(f"sync {Path(os.readlink(f'/proc/self/fd/{opened}')).name}")

    def replace(source: Path, target: Path) -> None:
        done.append(f"name {target.name}")
        real(source, target)

    real = os.replace
    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace)
    with staged_file(tmp_path / "a.json") as file:
        file.write_text("new")
    assert done == [f"sync .a.partial-{os.getpid()}.json", "name a.json", f"sync {tmp_path.name}"]


def test_a_full_disk_is_named(tmp_path: Path) -> None:
    with (
        pytest.raises(OSError, match=r"No space left on device: .*a\.json"),
        staged_file(tmp_path / "a.json"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert everything(tmp_path) == {}


def test_links_are_followed(tmp_path: Path) -> None:
    """One to nothing, too: what it names is written; one in a circle is refused at once."""
    for name in ("file", "folder", "circle"):
        (tmp_path / name).symlink_to(tmp_path / ("circle" if name == "circle" else f"{name}-1"))
    with staged_file(tmp_path / "file") as file:
        file.write_text("new")
    with staged_folder(tmp_path / "folder", NAMES) as folder:
        fill(folder, "new", ("results.json",))
    assert (tmp_path / "file-1").read_text() == "new"
    assert (tmp_path / "folder-1" / "results.json").read_text() == "new"
    with pytest.raises((ValueError, OSError), match="circle"), staged_file(tmp_path / "circle"):
        pytest.fail("entered")


def test_a_lock_is_held_by_one(tmp_path: Path) -> None:
    file = tmp_path / "run.json"
    file.write_text("{}")
    with locked(file, "busy"):
        with pytest.raises(ValueError, match="busy"), locked(file, "busy"):
            pytest.fail("entered")
        with locked(tmp_path, "busy"):
            pass
    with locked(file, "busy"):
        assert file.read_text() == "{}"
