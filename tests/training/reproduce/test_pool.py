"""Units of work in processes that die: nothing hangs, nothing is left behind, nothing is lost."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from units import Unit

from training.reproduce import pool


def test_dead_processes_are_replaced_and_what_always_dies_is_reported(tmp_path: Path) -> None:
    units = [Unit("a"), Unit("once", kills=1), Unit("always", kills=9), Unit("b", raises=True)]
    units += [Unit(f"c{i}") for i in range(3)]
    steps: list[int] = []
    outcome = dict(pool.work(units, tmp_path, 2, steps.append))  # type: ignore[arg-type]
    assert outcome.keys() == set(units)
    failed = {unit.name: why for unit, why in outcome.items() if why is not None}  # type: ignore[union-attr]
    assert failed.keys() == {"always", "b"}
    assert failed["always"] == "its process died 2 times (out of memory?)"
    assert failed["b"] == "ZeroDivisionError: by nothing"
    assert len(list(tmp_path.glob("always.try-*"))) == 2
    assert sum(steps) == sum(unit.size for unit in units)
    assert all(unit.done(tmp_path) for unit in units if unit.name not in failed)


def test_one_process_does_the_same(tmp_path: Path) -> None:
    units = [Unit("a"), Unit("b", raises=True)]
    steps: list[int] = []
    outcome = [why for _, why in pool.work(units, tmp_path, 1, steps.append)]  # type: ignore[arg-type]
    assert outcome == [None, "ZeroDivisionError: by nothing"]
    assert sum(steps) == 20


_PARENT = """
import signal
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from units import Unit
from training.reproduce import pool

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it
    units = [Unit(str(i), seconds=300.0) for i in range(4)]
    list(pool.work(units, Path(sys.argv[1]), 2, lambda size: None))
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
        _wait_for(lambda: len(list(out.glob("*.try-*"))) == 2, 60)
        workers = [int(file.name.rsplit("-", 1)[1]) for file in out.glob("*.try-*")]
        assert all(map(_running, workers))
        parent.send_signal(kill)
        parent.wait(60)
        _wait_for(lambda: not any(map(_running, workers)), 60)
    finally:
        parent.kill()
        parent.wait()


def _wait_for(what: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)
