"""Writing that is never half done, whatever ends the process: into a hidden neighbour first, then
renamed into place.

Data are on the disk before they get their name (fsync), so that a power cut, too, leaves the old or
the new. What a process that was killed left behind (``.NAME.partial-PID``) is removed by the next
one that writes NAME.
"""

import errno
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

_PLAN = "plan.json"


@contextmanager
def staged_folder(out: Path, names: Sequence[str]) -> Iterator[Path]:
    """A folder to write into; what lies there at the end of the block becomes ``out``.

    If the block raises, or is interrupted, nothing is left behind and ``out`` is as it was. Entries
    that ``out`` already has stay, but for those in ``names``, which belong to what is written:
    they are replaced, or removed where nothing new has their name. The last of ``names`` marks such
    a folder: it goes first and comes last. A replacement that was cut short by the end of its
    process is completed by the next one that writes ``out``, or by ``recover``.

    Whether ``out`` can be written is found out at once: ValueError if not, or if it holds some of
    ``names`` without the last of them (then they are somebody else's).
    """
    out = _resolved(out)
    if out.exists():
        if not out.is_dir():
            raise ValueError(f"{out} is not a folder")
        recover(out)
        foreign = [name for name in names if (out / name).exists()]
        if foreign and names[-1] not in foreign:
            raise ValueError(
                f"{out} holds {foreign[0]!r} but no {names[-1]}: it would be overwritten; "
                "give another folder"
            )
    with _made(out if out.exists() else out.parent, out) as partial:
        new = partial / "new"
        new.mkdir(parents=True)
        yield new
        _sync_tree(new)
        if not out.exists():
            os.rename(new, out)
            _sync(out.parent)
        else:
            with locked(out):
                _replace(out, partial, names)


@contextmanager
def staged_file(out: Path) -> Iterator[Path]:
    """A file name to write to, with the suffix of ``out``, which the file becomes at the end of the
    block; if the block raises, nothing is left behind. ValueError at once if it cannot be written.
    """
    out = _resolved(out)
    if out.is_dir():
        raise ValueError(f"{out} is a folder")
    with _made(out.parent, out) as partial:
        partial.touch()
        yield partial
        _sync(partial)
        os.replace(partial, out)
        _sync(out.parent)


class _Tried(Exception):
    pass


def require_writable(out: Path | None) -> None:
    """Raise what ``staged_file`` would at once, before what the file is to hold is computed."""
    if out is not None:
        with suppress(_Tried), staged_file(out):
            raise _Tried


def recover(out: Path) -> None:
    """Complete a replacement in the folder ``out`` that was cut short by the end of its process."""
    out = _resolved(out)
    journal = _journal(out)
    if journal.exists():
        with locked(out):
            if journal.exists():  # not another process's, which has completed it meanwhile
                _move_in(out, journal)
                _forget(out, journal)


def remove_leftovers(folder: Path) -> None:
    """Remove what processes that were killed left in a folder that is ours alone."""
    for leftover in list(folder.rglob(".*.partial-*")):
        _remove(leftover)


@contextmanager
def locked(path: Path, busy: str | None = None) -> Iterator[None]:
    """Hold the lock of a file or folder, which nobody else in the same block for it can have.

    Waits for it, or, with the words ``busy``, raises them as a ValueError if it is held. The lock
    ends with the process, however that ends. Where the file system has no locks, there is none.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    opened = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        try:
            fcntl.flock(opened, fcntl.LOCK_EX | (fcntl.LOCK_NB if busy else 0))
        except OSError as error:
            if busy and error.errno in (errno.EAGAIN, errno.EACCES):
                raise ValueError(busy) from None
        yield
    finally:
        os.close(opened)


# ------------------------------------------------------------------ the hidden neighbour


@contextmanager
def _made(parent: Path, out: Path) -> Iterator[Path]:
    """A hidden name in ``parent`` for what becomes ``out``; gone at the end, and so is the parent
    if it was made for this and nothing came of it."""
    missing = [p for p in (parent, *parent.parents) if not p.exists()]
    suffix = "" if out.is_dir() else out.suffix
    stem = out.name.removesuffix(suffix)
    partial, done = parent / f".{stem}.partial-{os.getpid()}{suffix}", False
    try:
        _make_writable(parent)
        for leftover in parent.glob(f".{_literal(stem)}.partial-*{_literal(suffix)}"):
            if _dead(leftover, suffix):
                _remove(leftover)
        yield partial
        done = True
    except OSError as error:
        hidden = str(error.filename or partial).startswith(str(partial))
        if hidden and error.errno is not None:
            error.filename = str(out)  # a full disk names nothing, others what is hidden
        raise
    finally:
        _remove(partial)
        if not done:
            for folder in missing:
                with suppress(OSError):
                    folder.rmdir()


def _dead(leftover: Path, suffix: str) -> bool:
    """Whether a partial was left by a process that is no more (or by one with our own number)."""
    number = leftover.name.removesuffix(suffix).rpartition("-")[2]
    if not number.isdecimal():
        return False
    try:
        os.kill(int(number), 0)
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:
        return False
    return int(number) == os.getpid()


def _remove(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink()


def _literal(text: str) -> str:
    """A pattern that matches a text only."""
    return "".join(f"[{c}]" if c in "*?[" else c for c in text)


def _resolved(out: Path) -> Path:
    """Where a path leads, links followed, which may not be there yet."""
    try:
        return out.resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise ValueError(f"{out} cannot be written: {error}") from None


def _make_writable(folder: Path) -> None:
    """See to it that there is such a folder; ValueError if it cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, "permission denied")
    except FileExistsError:
        raise ValueError(f"{folder} is not a folder") from None
    except OSError as error:
        raise ValueError(f"{folder} cannot be written: {error.strerror}") from error


# ------------------------------------------------------------------ replacing in a folder


def _journal(out: Path) -> Path:
    """Where a replacement in ``out`` lies from the moment on that it will be completed."""
    return out / f".{out.name}.journal"


def _replace(out: Path, partial: Path, names: Sequence[str]) -> None:
    """Exchange the entries ``names`` of ``out`` for those in ``partial / "new"``.

    One rename makes it certain: that of ``partial`` to a journal, which holds all that is new and
    the plan of what moves. Before it, nothing of ``out`` has moved; after it, whoever finds the
    journal can complete the moves, as often as they are cut short.
    """
    recover_first = _journal(out)
    if recover_first.exists():
        _move_in(out, recover_first)
        _forget(out, recover_first)
    new, marker = partial / "new", names[-1]
    plan = {
        "remove": sorted((n for n in names if _there(out / n)), key=lambda n: n != marker),
        "place": sorted((e.name for e in new.iterdir()), key=lambda n: n == marker),
    }
    (partial / "old").mkdir()
    (partial / _PLAN).write_text(json.dumps(plan), encoding="utf-8")
    _sync_tree(partial)
    os.rename(partial, _journal(out))
    try:
        _sync(out)
        _move_in(out, _journal(out))
    except BaseException:  # an interruption, or an entry that cannot be moved
        _move_back(out, _journal(out), plan)
        _forget(out, _journal(out))
        raise
    _forget(out, _journal(out))


def _move_in(out: Path, journal: Path) -> None:
    """Make the moves of a journal that have not been made."""
    plan = json.loads((journal / _PLAN).read_text(encoding="utf-8"))
    new, old = journal / "new", journal / "old"
    for name in plan["remove"]:
        placed = name in plan["place"] and not _there(new / name)
        if _there(out / name) and not placed:
            os.replace(out / name, old / name)
    for name in plan["place"]:
        if _there(new / name):
            os.replace(new / name, out / name)
    _sync(out)


def _move_back(out: Path, journal: Path, plan: Mapping[str, Sequence[str]]) -> None:
    """Undo the moves of a journal, the marker's last."""
    new, old = journal / "new", journal / "old"
    for name in reversed(plan["place"]):
        if not _there(new / name):
            os.replace(out / name, new / name)
    for name in reversed(plan["remove"]):
        if _there(old / name):
            os.replace(old / name, out / name)
    _sync(out)


def _forget(out: Path, journal: Path) -> None:
    """Remove a journal: at once as such, then as what it holds."""
    partial = out / f".{out.name}.partial-{os.getpid()}"
    os.rename(journal, partial)
    _sync(out)
    _remove(partial)


def _there(path: Path) -> bool:
    return os.path.lexists(path)


def _sync_tree(folder: Path) -> None:
    """Put all that a folder holds on the disk."""
    for path in folder.rglob("*"):
        if not path.is_symlink():
            _sync(path)
    _sync(folder)


def _sync(path: Path) -> None:
    """Put a file, or a folder's list of names, on the disk; where that cannot be asked for, go
    on."""
    try:
        opened = os.open(path, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(opened)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EIO, errno.EDQUOT):
            raise
    finally:
        os.close(opened)
