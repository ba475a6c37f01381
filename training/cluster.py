"""Units of work on a Ray cluster: any number of machines, as ``training.pool`` has processes.

Ray starts a worker for every CPU, gives a unit of a dead worker or machine to another, and brings
results here. The process that asks must run on a machine of the cluster.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from training.threads import use_threads
from training.units import REPORT_EVERY, Outcome, U, Unit, WorkerDied, checked_outcome

_RETRIES = 3  # of a unit whose worker or machine dies
_CONNECT = 5.0  # s that a cluster's address may take to answer
_GONE = 15.0  # s without an answer after which a cluster counts as dead
_INHERITED = ("COLOC_DATA",)  # of the environment


@contextmanager
def connected(address: str) -> Iterator[None]:
    """Connect to the cluster at an address, "auto" for the one that runs on this machine; where
    this process is connected already, that stands.

    Raises ValueError, in one line, without Ray, without a cluster, or for one that does not answer.
    """
    try:
        import ray
    except ImportError:
        raise ValueError("--ray needs Ray: pip install 'coloc-env[ray]'") from None
    if ray.is_initialized():
        yield
        return
    if address != "auto":
        _require_answer(address)
    try:
        ray.init(address, log_to_driver=False, logging_level="ERROR")
    except Exception as error:
        why = str(error).split("\n")[0]
        raise ValueError(
            f"--ray {address}: no Ray cluster here that answers ({why}); `ray start --head` starts "
            "one, `ray start --address=HEAD:6379` lets this machine join one"
        ) from None
    try:
        yield
    finally:
        ray.shutdown()


def _require_answer(address: str) -> None:
    """Raise ValueError for an address at which nobody listens."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 1 << 16:
        raise ValueError(f"--ray {address} is not allowed: auto, or HOST:PORT of a cluster's head")
    if not _answers(address):
        raise ValueError(
            f"--ray {address}: nobody answers there; `ray start --head` starts a cluster and says "
            "its address"
        )


def _answers(address: str) -> bool:
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), _CONNECT).close()
    except OSError:
        return False
    return True


def work(
    units: Sequence[U], address: str, progress: Callable[[U, int], None]
) -> Iterator[Outcome[U]]:
    """``training.pool.work`` on a cluster, a unit a CPU. ConnectionError if the cluster dies."""
    with connected(address):
        import ray
        from ray.exceptions import RayError

        head = ray.get_runtime_context().gcs_address
        counts, run = _counts(), ray.remote(num_cpus=1, max_retries=_RETRIES)(_run)
        environment = {name: os.environ[name] for name in _INHERITED if name in os.environ}
        left = {
            run.remote(unit, unit.settings(), i, counts, os.getcwd(), environment): (i, unit)
            for i, unit in enumerate(units)
        }
        done = [0] * len(units)
        try:
            while left:
                ready, _ = ray.wait(list(left), num_returns=1, timeout=REPORT_EVERY)
                _require_alive(head)
                with suppress(RayError):  # the actor starts, or starts again
                    running = {i for i, _ in left.values()}
                    noted = ray.get(counts.read.remote(), timeout=_CONNECT)
                    for i in running & noted.keys():
                        progress(units[i], noted[i] - done[i])
                        done[i] = noted[i]
                for one in ready:
                    i, unit = left.pop(one)
                    try:
                        result, error = ray.get(one)
                    except RayError as died:
                        why = " ".join(str(died).split())
                        result, error = None, WorkerDied(f"{1 + _RETRIES} times: {why}")
                    progress(unit, unit.size - done[i])
                    done[i] = unit.size
                    yield Outcome(unit, result, error)
        finally:
            for one in left:
                ray.cancel(one, force=True)
            ray.kill(counts)


def _require_alive(head: str) -> None:
    """Raise ConnectionError for a cluster whose head has not answered for a while: Ray itself would
    end this process without a word."""
    start = time.monotonic()
    while not _answers(head):
        if time.monotonic() - start > _GONE:
            raise ConnectionError(
                f"the Ray cluster at {head} is gone; what was stored is kept: start a cluster and "
                "run the command again"
            )
        time.sleep(1.0)


class _Counts:
    """How many steps of each unit are done; an actor beside the process that asks."""

    def __init__(self) -> None:
        self.steps: dict[int, int] = {}

    def note(self, index: int, steps: int) -> None:
        self.steps[index] = steps

    def read(self) -> dict[int, int]:
        found, self.steps = self.steps, {}
        return found


def _counts() -> Any:
    """The actor, on this machine, and with no CPU of its own."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    actor = ray.remote(num_cpus=0, max_restarts=-1, scheduling_strategy=here)(_Counts)
    return actor.remote()


def _run(
    unit: Unit,
    settings: Mapping[str, Any],
    index: int,
    counts: Any,
    folder: str,
    environment: Mapping[str, str],
) -> tuple[Any, Exception | None]:
    """In a worker: a unit as it would run in the process that asks, on one thread."""
    use_threads(1)
    os.environ.update(environment)
    with suppress(OSError):  # a machine of its own; files by relative names are then not there
        os.chdir(folder)
    done, last = 0, 0.0

    def progress(size: int) -> None:
        nonlocal done, last
        done += size
        if time.monotonic() - last > REPORT_EVERY:
            counts.note.remote(index, done)
            last = time.monotonic()

    differs = f"code, weights or torch on {socket.gethostname()} are not those of this machine"
    return checked_outcome(unit, settings, progress, differs)
