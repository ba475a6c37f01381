"""Units of work in one process or several: what fails is reported, and nothing waits for ever.

A worker ends with its parent, however that ends. A unit whose worker dies is tried once more.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from training.reproduce.work import Unit

_OFTEN = 0.5  # s between a worker's reports of its progress
_ATTEMPTS = 2


def work(
    units: Sequence[Unit], out: Path, jobs: int, progress: Callable[[int], None]
) -> Iterator[tuple[Unit, str | None]]:
    """Run units, ``jobs`` at a time; yield each as it is done, with what went wrong, if anything.

    ``progress`` is given what is done of the units' sizes.
    """
    if jobs == 1 or len(units) < 2:
        for unit in units:
            yield unit, _outcome(unit, out, progress)
    else:
        yield from _spread(units, out, min(jobs, len(units)), progress)


def _outcome(unit: Unit, out: Path, progress: Callable[[int], None]) -> str | None:
    """Run a unit; what it raises is returned as words, an interruption aside."""
    done = 0

    def counted(size: int) -> None:
        nonlocal done
        done += size
        progress(size)

    try:
        unit.run(out, counted)
    except Exception as error:
        progress(unit.size - done)
        return f"{type(error).__name__}: {error}"
    return None


# ------------------------------------------------------------------ several processes


class _Worker:
    """A process that runs one unit at a time."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=_serve, args=(other,), daemon=True)
        self.process.start()
        other.close()  # so that the pipe ends when the worker does
        self.unit: Unit | None = None
        self.done = 0  # of the unit's size

    def give(self, unit: Unit, out: Path) -> None:
        self.unit, self.done = unit, 0
        with suppress(BrokenPipeError):  # it died: to wait for its answer is to learn that
            self.pipe.send((unit, unit.settings(), out))

    def end(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _spread(
    units: Sequence[Unit], out: Path, jobs: int, progress: Callable[[int], None]
) -> Iterator[tuple[Unit, str | None]]:
    left, attempts = list(reversed(units)), dict.fromkeys(units, 0)
    workers: list[_Worker] = []
    try:
        while left or workers:
            while left and len(workers) < jobs:
                workers.append(_Worker())
                workers[-1].give(_next(left, attempts), out)
            for pipe in wait([worker.pipe for worker in workers]):
                worker = next(each for each in workers if each.pipe is pipe)
                unit = worker.unit
                assert unit is not None
                try:
                    size, error, finished = worker.pipe.recv()
                except (EOFError, OSError):  # it died
                    workers.remove(worker)
                    worker.end()
                    progress(-worker.done)
                    if attempts[unit] < _ATTEMPTS:
                        left.append(unit)
                    else:
                        progress(unit.size)
                        yield unit, f"its process died {_ATTEMPTS} times (out of memory?)"
                    continue
                worker.done += size
                progress(size)
                if finished:
                    yield unit, error
                    if left:
                        worker.give(_next(left, attempts), out)
                    else:
                        workers.remove(worker)
                        worker.end()
    finally:
        for worker in workers:
            worker.end()


def _next(left: list[Unit], attempts: dict[Unit, int]) -> Unit:
    attempts[left[-1]] += 1
    return left.pop()


def _serve(pipe: Connection) -> None:
    """In a worker: the parent alone hears Ctrl-C, and its end is the worker's."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    held, last = 0, 0.0

    def progress(size: int) -> None:
        nonlocal held, last
        held += size
        if time.monotonic() - last > _OFTEN:
            pipe.send((held, None, False))
            held, last = 0, time.monotonic()

    while True:
        try:
            unit, settings, out = pipe.recv()
        except EOFError:
            return
        held = 0
        error: str | None = "the code changed while the study ran: run the command again"
        if unit.settings() == settings:
            error = _outcome(unit, out, progress)
        pipe.send((held, error, True))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
