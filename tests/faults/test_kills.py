"""Killed at any moment, nothing is lost and nothing is half written: evaluate, train, reproduce.

The moments are drawn from a seed. ``COLOC_KILLS=34`` sends a hundred signals (three commands);
without it, a few.
"""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow  # .ci/run has it
KILLS = int(os.environ.get("COLOC_KILLS", "2"))  # of each command
COLOC = (sys.executable, "-c", "from training.cli.command import main; main()")
EVALUATE = ("evaluate", "indoor-v0", "--agents", "dead_reckoning,ekf", "--runs", "2")
EVALUATE = (*EVALUATE, "--set", "horizon=60", "--no-bound")
TRAIN = ("train", "pfnn", "--set", "epochs=6", "--set", "worlds=2")
TRAIN = (*TRAIN, "--set", "scenario=indoor-v0:motion=random:horizon=20")
REPRODUCE = ("reproduce", "nnhpff", "--part", "paper", "--agents", "ekf", "--runs", "1")
REPRODUCE = (*REPRODUCE, "--steps", "30", "--jobs", "2")
LONG = 1800.0  # s: nothing hangs
RESULTS = ("results.json", "results.csv", "table.md")


def run(words: tuple[str, ...], kill_after: float | None = None) -> int:
    """The command's exit status; killed after so many seconds (None: not at all)."""
    process = subprocess.Popen(
        [*COLOC, *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    if kill_after is not None:
        time.sleep(kill_after)
        process.send_signal(signal.SIGKILL)
    return process.wait(timeout=LONG)


def moments(words: tuple[str, ...], seed: int) -> list[float]:
    """When to kill: anywhere in the time that the command takes."""
    start = time.monotonic()
    assert run(words) == 0
    lasts = time.monotonic() - start
    drawn = random.Random(seed)
    return [drawn.uniform(0.05, 1.0) * lasts for _ in range(KILLS)]


def children_of_a_session(session: int) -> list[int]:
    """Processes that still live in a session."""
    listed = subprocess.run(
        ["ps", "-o", "pid=", "-s", str(session)], capture_output=True, text=True
    ).stdout
    return [int(pid) for pid in listed.split()]


def figures(folder: Path) -> dict[str, object]:
    """What results.json says, its times aside."""
    found = json.loads((folder / "results.json").read_text())
    for agent in found["agents"].values():
        agent.pop("ms_per_step")
    return found


def test_an_evaluation_is_whole_or_not_there(tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    times = moments((*EVALUATE, "--out", str(whole)), seed=1)
    expected = figures(whole)
    out = tmp_path / "out"
    for after in times:
        run((*EVALUATE, "--out", str(out)), after)
        if (out / "results.json").exists():
            assert all((out / name).exists() for name in RESULTS)
            assert figures(out) == expected
        else:
            assert not out.exists() or not any(out.iterdir())
        assert run((*EVALUATE, "--out", str(out))) == 0  # goes, whatever was left behind
        assert figures(out) == expected
        assert not [path for path in tmp_path.iterdir() if ".partial-" in path.name]


def test_a_training_continues_to_the_same_weights(tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    times = moments((*TRAIN, "--out", str(whole)), seed=2)
    expected = (whole / "pfnn.safetensors").read_bytes()
    out = tmp_path / "out"
    for i, after in enumerate(times):
        folder = out.with_name(f"out{i}")
        run((*TRAIN, "--out", str(folder)), after)
        if (folder / "run.json").exists():
            assert run(("train", "--resume", str(folder))) == 0
        else:
            assert run((*TRAIN, "--out", str(folder))) == 0
        assert (folder / "pfnn.safetensors").read_bytes() == expected


@pytest.mark.skipif(not Path("/proc").exists(), reason="looks at processes as Linux lists them")
def test_a_study_goes_on_and_leaves_no_worker_behind(tmp_path: Path) -> None:
    out = tmp_path / "whole"
    times = moments((*REPRODUCE, "--out", str(out)), seed=3)
    expected = sorted(path.name for path in out.rglob("*.npz"))
    for i, after in enumerate(times):
        folder = tmp_path / f"out{i}"
        process = subprocess.Popen(
            [*COLOC, *REPRODUCE, "--out", str(folder)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        time.sleep(after)
        process.send_signal(signal.SIGKILL)
        process.wait()
        until = time.monotonic() + 60
        while children_of_a_session(process.pid) and time.monotonic() < until:
            time.sleep(0.2)
        assert not children_of_a_session(process.pid)
        assert run((*REPRODUCE, "--out", str(folder))) == 0
        assert sorted(path.name for path in folder.rglob("*.npz")) == expected
