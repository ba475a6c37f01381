"""Units of work in processes that die: nothing hangs, nothing is left behind, nothing is lost."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from units import Unit

from training import pool
from training.pool import Workers
from training.units import WorkerDied


def test_dead_processes_are_replaced_and_what_always_dies_is_reported(tmp_path: Path) -> None:
    out = tmp_path
    units = [Unit(out, "a"), Unit(out, "once", kills=1), Unit(out, "always", kills=9)]
    units += [Unit(out, "b", raises=True)] + [Unit(out, f"c{i}") for i in range(3)]
    steps: list[int] = []
    found = list(pool.work(units, Workers(2), lambda _, size: steps.append(size)))
    assert {one.unit for one in found} == set(units)
    failed = {one.unit.name: one.error for one in found if one.error is not None}
    assert failed.keys() == {"always", "b"}
    assert isinstance(failed["always"], WorkerDied)
    assert str(failed["always"]) == "2 times (out of memory?)"
    assert isinstance(failed["b"], ZeroDivisionError)
    assert str(failed["b"]) == "by nothing"
    assert len(list(tmp_path.glob("always.try-*"))) == 2
    assert sum(steps) == sum(unit.size for unit in units)
    assert all(one.result == one.unit.name for one in found if one.error is None)
    assert all(unit.done() for unit in units if unit.name not in failed)


def test_one_process_does_the_same(tmp_path: Path) -> None:
    units = [Unit(tmp_path, "a"), Unit(tmp_path, "b", raises=True)]
    steps: list[int] = []
    first, second = pool.work(units, pool.ALONE, lambda _, size: steps.append(size))
    assert (first.result, first.error) == ("a", None)
    assert isinstance(second.error, ZeroDivisionError)
    assert sum(steps) == 20


@pytest.mark.parametrize(
    ("jobs", "ray", "why"), [(0, None, "--jobs 0"), (2, "auto", "--jobs and --ray")]
)
def test_workers_that_cannot_be_are_refused(jobs: int, ray: str | None, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        Workers(jobs, ray)


_PARENT = """
import signal
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from units import Unit
from training import pool

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it
    units = [Unit(Path(sys.argv[1]), str(i), seconds=300.0) for i in range(4)]
    list(pool.work(units, pool.Workers(2), lambda unit, size: None))
"""


def _running(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"  # a zombie waits for whoever adopted it


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize("kill", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_workers_end_with_their_parent(kill: signal.Signals, tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(_PARENT)
    out = tmp_path / "out"
    out.mkdir()
    command = [sys.executable, str(script), str(out), str(Path(__file__).parent)]
    parent = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        _wait_for(lambda: len(list(out.glob("*.try-*"))) == 2, 300)
        workers = [int(file.name.rsplit("-", 1)[1]) for file in out.glob("*.try-*")]
        assert all(map(_running, workers))
        parent.send_signal(kill)
        parent.wait(120)
        _wait_for(lambda: not any(map(_running, workers)), 120)
    finally:
        parent.kill()
        parent.wait()


def _wait_for(what: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)
