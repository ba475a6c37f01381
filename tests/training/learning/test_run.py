"""Training runs: interrupted anywhere, they continue to the weights of an unbroken run."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from training.learning import pfnn
from training.learning import run as runs
from training.learning import state as states

SMALL = {"scenario": "indoor-v0:n_uavs=2:horizon=10", "worlds": 1, "epochs": 4, "score_runs": 0}


def quiet(what: str, done: int, total: int) -> None:
    pass


def outcome(folder: Path) -> dict[str, bytes]:
    """Weights and metrics of a finished run."""
    files = [folder / "pfnn.safetensors", *sorted((folder / "metrics/scalars").glob("*.csv"))]
    return {file.name: file.read_bytes() for file in files}


@pytest.fixture(scope="module", params=["offline", "online"])
def mode(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def unbroken(mode: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("unbroken") / mode
    runs.start("pfnn", {"mode": mode} | SMALL, folder, quiet)
    assert not (folder / "state.safetensors").exists()
    assert list((folder / "tensorboard").glob("events.*"))
    return outcome(folder)


def test_same_seed_same_weights(mode: str, unbroken: dict[str, bytes], tmp_path: Path) -> None:
    runs.start("pfnn", {"mode": mode} | SMALL, tmp_path / "same", quiet)
    assert outcome(tmp_path / "same") == unbroken
    runs.start("pfnn", {"mode": mode, "seed": 1} | SMALL, tmp_path / "other", quiet)
    other = outcome(tmp_path / "other")
    assert other["pfnn.safetensors"] != unbroken["pfnn.safetensors"]


@pytest.mark.parametrize("losses", [1, 5, 8])
def test_interrupted_in_training(
    mode: str,
    unbroken: dict[str, bytes],
    losses: int,
    tmp_path: Path,
    interrupted: Callable[..., Any],
) -> None:
    with interrupted(pfnn.CorrectorLoss, "forward", losses):
        runs.start("pfnn", {"mode": mode} | SMALL, tmp_path / "run", quiet)
    runs.resume(tmp_path / "run", quiet)
    assert outcome(tmp_path / "run") == unbroken


def test_interrupted_in_saving(
    mode: str, unbroken: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that dies half-way through writing cleans nothing up."""
    saved = 0

    def dies(file: Path, state: Any) -> None:
        nonlocal saved
        saved += 1
        if saved == 3:
            (file.parent / ".state.partial-1.safetensors").write_bytes(b"half")
            raise SystemExit
        keep(file, state)

    keep = states.save
    monkeypatch.setattr(states, "save", dies)
    with pytest.raises(SystemExit):
        runs.start("pfnn", {"mode": mode} | SMALL, tmp_path / "run", quiet)
    monkeypatch.undo()
    scalars = tmp_path / "run/metrics/scalars"
    with (scalars / "rmse.csv").open("a") as file:
        file.write("1000,0.1")
    runs.resume(tmp_path / "run", quiet)
    assert outcome(tmp_path / "run") == unbroken
    assert not list((tmp_path / "run").rglob(".*"))


def test_killed(mode: str, unbroken: dict[str, bytes], tmp_path: Path) -> None:
    """kill -9 of the command, somewhere in an epoch after the first."""
    settings = [f"--set={key}={value}" for key, value in ({"mode": mode} | SMALL).items()]
    out = tmp_path / "run"
    command = [
        sys.executable,
        "-m",
        "training.cli.command",
        "train",
        "pfnn",
        *settings,
        f"--out={out}",
    ]
    process = subprocess.Popen(
        command,
        cwd=Path(__file__).parents[3],
        stderr=subprocess.PIPE,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    state, deadline = out / "state.safetensors", time.monotonic() + 300
    while process.poll() is None and time.monotonic() < deadline:
        if state.exists() and states.load(state)["trainer"]["collector"]["epoch"] >= 1:
            break
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    _, errors = process.communicate()
    assert process.returncode == -signal.SIGKILL, errors.decode()
    assert not (out / "pfnn.safetensors").exists()
    runs.resume(out, quiet)
    assert outcome(out) == unbroken


def test_a_finished_run_stays_as_it_is(mode: str, tmp_path: Path) -> None:
    short = SMALL | {"mode": mode, "epochs": 1}
    weights = runs.start("pfnn", short, tmp_path / "run", quiet)
    before = weights.stat().st_mtime_ns
    assert runs.resume(tmp_path / "run", quiet) == weights
    assert weights.stat().st_mtime_ns == before
    with pytest.raises(ValueError, match="holds a run: --resume"):
        runs.start("pfnn", short, tmp_path / "run", quiet)
    (tmp_path / "run/run.json").unlink()
    with pytest.raises(ValueError, match="is not empty"):
        runs.start("pfnn", short, tmp_path / "run", quiet)


def test_card(tmp_path: Path) -> None:
    options = SMALL | {"epochs": 1, "score_runs": 2}
    weights = runs.start("pfnn", options, tmp_path / "run", quiet)
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["command"].startswith("coloc train pfnn --set scenario=indoor-v0:n_uavs=2")
    assert card["options"]["learning_rate"] == 0.01
    assert card["frames"] == 10
    assert card["metrics"].keys() >= {"rmse", "held_out_loss", "loss_corrector"}
    assert 0 < card["scores"]["pfnn_rmse"] < 5


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "is not JSON"),
        ("[]", "describes no run"),
        ('{"training": "pfnn"}', "describes no run"),
        ('{"training": "x", "options": {}, "command": "", "threads": 1}', "unknown training 'x'"),
        (
            '{"training": "pfnn", "options": {"epoch": 1}, "command": "", "threads": 1}',
            "did you mean 'epochs'",
        ),
    ],
)
def test_not_a_run(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ValueError, match="holds no run"):
        runs.resume(tmp_path, quiet)
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(ValueError, match=words):
        runs.resume(tmp_path, quiet)


def test_damaged_save_point(tmp_path: Path) -> None:
    state = {
        "weights": {"a": torch.randn(3), "b": torch.tensor(2.5)},
        "optimizer": {"state": {0: {"step": torch.tensor(1.0)}}, "groups": [{"lr": 0.1}, None]},
    }
    file = tmp_path / "state.safetensors"
    states.save(file, state)
    again = states.load(file)
    assert torch.equal(again["weights"]["a"], state["weights"]["a"])
    assert again["optimizer"]["state"][0]["step"] == 1
    assert again["optimizer"]["groups"] == [{"lr": 0.1}, None]
    file.write_bytes(file.read_bytes()[:-3])
    with pytest.raises(ValueError, match="damaged"):
        states.load(file)
