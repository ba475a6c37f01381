"""Units of work in one process, several, or on a Ray cluster: what fails is reported, nothing waits
for ever, and no result depends on where it was computed.

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
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from typing import Generic

from training.units import REPORT_EVERY, Outcome, U, WorkerDied, checked_outcome, outcome

_ATTEMPTS = 2


@dataclass(frozen=True)
class Workers:
    """Who works: ``jobs`` processes of this machine (1: this process), or the Ray cluster at the
    address ``ray`` ("auto": the one that runs on this machine).

    Raises ValueError for both, and for less than one process.
    """

    jobs: int = 1
    ray: str | None = None

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise ValueError(f"--jobs {self.jobs} is not allowed: at least 1")
        if self.ray is not None and self.jobs > 1:
            raise ValueError("--jobs and --ray: one or the other says who works")


ALONE = Workers()


def work(
    units: Sequence[U], workers: Workers, progress: Callable[[U, int], None]
) -> Iterator[Outcome[U]]:
    """Run units, and yield each as it is done. ``progress`` is given a unit and how many of its
    steps have been done since it was last called."""
    if workers.ray is not None:
        from training import cluster

        yield from cluster.work(units, workers.ray, progress)
    elif workers.jobs == 1 or len(units) < 2:
        for unit in units:
            yield Outcome(unit, *outcome(unit, partial(progress, unit)))
    else:
        yield from _spread(units, min(workers.jobs, len(units)), progress)


# ------------------------------------------------------------------ several processes


class _Worker(Generic[U]):
    """A process that runs one unit at a time."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=_serve, args=(other,), daemon=True)
        self.process.start()
        other.close()  # so that the pipe ends when the worker does
        self.unit: U | None = None
        self.done = 0  # of the unit's size

    def give(self, unit: U) -> None:
        self.unit, self.done = unit, 0
        with suppress(BrokenPipeError):  # it died: to wait for its answer is to learn that
            self.pipe.send((unit, unit.settings()))

    def end(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _spread(
    units: Sequence[U], jobs: int, progress: Callable[[U, int], None]
) -> Iterator[Outcome[U]]:
    left, attempts = list(reversed(units)), dict.fromkeys(map(id, units), 0)
    workers: list[_Worker[U]] = []

    def following() -> U:
        attempts[id(left[-1])] += 1
        return left.pop()

    try:
        while left or workers:
            while left and len(workers) < jobs:
                workers.append(_Worker())
                workers[-1].give(following())
            for pipe in wait([worker.pipe for worker in workers]):
                worker = next(each for each in workers if each.pipe is pipe)
                unit = worker.unit
                assert unit is not None
                try:
                    size, answer = worker.pipe.recv()
                except (EOFError, OSError):  # it died
                    workers.remove(worker)
                    worker.end()
                    progress(unit, -worker.done)
                    if attempts[id(unit)] < _ATTEMPTS:
                        left.append(unit)
                    else:
                        progress(unit, unit.size)
                        yield Outcome(unit, error=WorkerDied(f"{_ATTEMPTS} times (out of memory?)"))
                    continue
                worker.done += size
                progress(unit, size)
                if answer is not None:
                    yield Outcome(unit, *answer)
                    if left:
                        worker.give(following())
                    else:
                        workers.remove(worker)
                        worker.end()
    finally:
        for worker in workers:
            worker.end()


def _serve(pipe: Connection) -> None:
    """In a worker: the parent alone hears Ctrl-C, and its end is the worker's."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    held, last = 0, 0.0

    def progress(size: int) -> None:
        nonlocal held, last
        held += size
        if time.monotonic() - last > REPORT_EVERY:
            pipe.send((held, None))
            held, last = 0, time.monotonic()

    changed = "the code changed while the study ran: run the command again"
    while True:
        try:
            unit, settings = pipe.recv()
        except EOFError:
            return
        held = 0
        answer = checked_outcome(unit, settings, progress, changed)
        pipe.send((held, answer))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
