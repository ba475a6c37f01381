"""Writing that is never half done: into a hidden neighbour first, then renamed into place."""

import errno
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def staged_folder(out: Path, names: Sequence[str]) -> Iterator[Path]:
    """A folder to write into; what lies there at the end of the block becomes ``out``.

    If the block raises, or is interrupted, nothing is left behind and ``out`` is as it was. Entries
    that ``out`` already has stay, but for those in ``names``, which belong to what is written:
    they are replaced, or removed where nothing new has their name. Whether ``out`` can be written
    is found out at once: ValueError if not, or if it holds some of ``names`` without the last of
    them, which marks such a folder (then they are somebody else's).
    """
    out = out.absolute()
    if out.is_symlink() and not out.exists():
        raise ValueError(f"{out} is a link to nothing")
    if out.exists():
        if not out.is_dir():
            raise ValueError(f"{out} is not a folder")
        foreign = [name for name in names if (out / name).exists()]
        if foreign and names[-1] not in foreign:
            raise ValueError(
                f"{out} holds {foreign[0]!r} but no {names[-1]}: it would be overwritten; "
                "give another folder"
            )
    with _made(
        out if out.exists() else out.parent, f".{out.name}.partial-{os.getpid()}"
    ) as partial:
        partial.mkdir()
        new = partial / "new"
        new.mkdir()
        yield new
        if out.exists():
            _replace(out, new, partial / "old", names)
        else:
            os.rename(new, out)


@contextmanager
def staged_file(out: Path) -> Iterator[Path]:
    """A file name to write to, with the suffix of ``out``, which the file becomes at the end of the
    block; if the block raises, nothing is left behind. ValueError at once if it cannot be written.
    """
    out = out.absolute()
    if out.is_dir():
        raise ValueError(f"{out} is a folder")
    with _made(out.parent, f".{out.stem}.partial-{os.getpid()}{out.suffix}") as partial:
        partial.touch()
        yield partial
        os.replace(partial, out)


@contextmanager
def _made(parent: Path, name: str) -> Iterator[Path]:
    """``parent / name`` for something to be made there; gone at the end, and so is the parent if it
    was made for this and nothing came of it."""
    missing = [p for p in (parent, *parent.parents) if not p.exists()]
    partial, done = parent / name, False
    try:
        _make_writable(parent)
        yield partial
        done = True
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        with suppress(OSError):
            partial.unlink()
        if not done:
            for folder in missing:
                with suppress(OSError):
                    folder.rmdir()


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


def _replace(out: Path, new: Path, old: Path, names: Sequence[str]) -> None:
    """Exchange the entries ``names`` of ``out`` for those in ``new``; all of them or none."""
    old.mkdir()
    entries = sorted(new.iterdir(), key=lambda entry: entry.name == names[-1])
    removed, placed = [], []
    try:
        for name in names:
            if (out / name).exists():
                os.replace(out / name, old / name)
                removed.append(name)
        for entry in entries:
            os.replace(entry, out / entry.name)
            placed.append(entry.name)
    except BaseException:
        for name in placed:
            os.replace(out / name, new / name)
        for name in removed:
            os.replace(old / name, out / name)
        raise
