"""Doing pieces of work in one process or several, with progress; what fails is told, not fatal."""

import multiprocessing
import queue
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import torch

from training.evaluation.evaluate import Progress
from training.reproduce.store import Store
from training.reproduce.study import Piece, Study, compute

Note = Callable[[str], None]
_OFTEN = 0.5  # s between reports of a process
_ticks: Any = None  # in a worker: where it reports


def fly(study: Study, pieces: Sequence[Piece], jobs: int, tell: Progress, note: Note) -> None:
    """Compute what is missing of ``pieces``, ``jobs`` at a time, each stored once it is done.

    ``tell`` gets the share of all steps flown, ``note`` a line for every piece done. A piece that
    raises is noted in ``study.failed``; the others go on.
    """
    left = study.missing(pieces)
    total, flown, start = sum(piece.size for piece in left), 0, time.monotonic()
    for agent, why in dict.fromkeys((a, w) for (_, a), w in study.failed.items()):
        note(f"{agent}: {why}")

    def tick(steps: int) -> None:
        nonlocal flown
        flown += steps
        tell("flights", flown, total)

    if left:
        tick(0)
    for done, (piece, error) in enumerate(_work(left, study.store, jobs, tick), 1):
        what = f"{done}/{len(left)} {piece.name}"
        if error is not None:
            study.failed[piece.variant.key, piece.agent] = error
            what += f" failed: {error}"
        note(f"{what} ({time.monotonic() - start:.0f} s)")


def obtain(
    study: Study, pieces: Sequence[Piece], jobs: int, tell: Progress, note: Note, missing: bool
) -> None:
    """``fly``; with ``missing=False`` only note in ``study.failed`` what there is not."""
    if missing:
        fly(study, pieces, jobs, tell, note)
    else:
        study.do_without(pieces)


def _work(
    left: Sequence[Piece], store: Store, jobs: int, tick: Callable[[int], None]
) -> Iterator[tuple[Piece, str | None]]:
    if jobs == 1 or len(left) < 2:
        for piece in left:
            yield piece, _outcome(piece, store, tick)
    else:
        yield from _spread(left, store, jobs, tick)


def _outcome(piece: Piece, store: Store, tick: Callable[[int], None]) -> str | None:
    """Compute a piece; what it raises is returned as words, an interruption aside."""
    before = 0

    def tell(what: str, done: int, total: int) -> None:
        nonlocal before
        if what == piece.agent:
            tick(done - before)
            before = done

    try:
        compute(piece, store, tell)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    finally:
        tick(piece.size - before)
    return None


# ------------------------------------------------------------------ several processes


def _spread(
    left: Sequence[Piece], store: Store, jobs: int, tick: Callable[[int], None]
) -> Iterator[tuple[Piece, str | None]]:
    context = multiprocessing.get_context("spawn")
    ticks = context.Queue()
    pool = ProcessPoolExecutor(jobs, context, _begin, (ticks,))
    try:
        asked = {pool.submit(_task, piece, piece.settings(), store.folder): piece for piece in left}
        open_: set[Future[str | None]] = set(asked)
        while open_:
            done, open_ = wait(open_, _OFTEN, FIRST_COMPLETED)
            _drain(ticks, tick)
            for future in done:
                yield asked[future], future.result()
    except BrokenProcessPool:
        raise ChildProcessError(
            "a process ended abruptly (out of memory?); what is done is kept: the same command "
            "goes on from there"
        ) from None
    except BaseException:
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _drain(ticks: Any, tick: Callable[[int], None]) -> None:
    while True:
        try:
            tick(ticks.get_nowait())
        except queue.Empty:
            return


def _begin(ticks: Any) -> None:
    """In a worker: one thread, reports to ``ticks``, and the parent alone hears Ctrl-C."""
    global _ticks
    _ticks = ticks
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)


def _task(piece: Piece, settings: dict[str, Any], folder: Path) -> str | None:
    if piece.settings() != settings:
        return "the code changed while the study ran: run the command again"
    held, last = 0, 0.0

    def tick(steps: int) -> None:
        nonlocal held, last
        held += steps
        if time.monotonic() - last > _OFTEN:
            _ticks.put(held)
            held, last = 0, time.monotonic()

    error = _outcome(piece, Store(folder), tick)
    _ticks.put(held)
    return error
