"""Training runs: interrupted anywhere, they continue to the weights of an unbroken run."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from coloc_env import state_file
from coloc_env.options import fits
from tests.sampling import first_fast
from training.learning import pfnn
from training.learning import run as runs
from training.learning.collectors import EpochCollector
from training.learning.registry import TRAININGS

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


@pytest.mark.slow
def test_same_seed_same_weights(mode: str, unbroken: dict[str, bytes], tmp_path: Path) -> None:
    runs.start("pfnn", {"mode": mode} | SMALL, tmp_path / "same", quiet)
    assert outcome(tmp_path / "same") == unbroken
    runs.start("pfnn", {"mode": mode, "seed": 1} | SMALL, tmp_path / "other", quiet)
    other = outcome(tmp_path / "other")
    assert other["pfnn.safetensors"] != unbroken["pfnn.safetensors"]


@pytest.mark.parametrize("losses", first_fast(5, 1, 8))
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

    keep = state_file.save
    monkeypatch.setattr(state_file, "save", dies)
    with pytest.raises(SystemExit):
        runs.start("pfnn", {"mode": mode} | SMALL, tmp_path / "run", quiet)
    monkeypatch.undo()
    scalars = tmp_path / "run/metrics/scalars"
    with (scalars / "rmse.csv").open("a") as file:
        file.write("1000,0.1")
    runs.resume(tmp_path / "run", quiet)
    assert outcome(tmp_path / "run") == unbroken
    assert not list((tmp_path / "run").rglob(".*"))


@pytest.mark.slow
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
        if state.exists() and state_file.load(state)["trainer"]["collector"]["epoch"] >= 1:
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
        ("[]", "is not a run"),
        ('{"training": "pfnn"}', "is not a run"),
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


def test_a_state_is_read_back_or_refused(tmp_path: Path) -> None:
    """Any bit that changes anything: the weights would be others, and nobody would know."""
    state = {
        "weights": {"a": torch.randn(3), "b": torch.tensor(2.5), "c": torch.tensor([True])},
        "optimizer": {"state": {0: {"step": torch.tensor(1.0)}}, "groups": [{"lr": 0.1}, None]},
    }
    file = tmp_path / "state.safetensors"
    state_file.save(file, state)

    def same() -> bool:
        again = state_file.load(file)
        return (
            all(
                torch.equal(again["weights"][key], value) for key, value in state["weights"].items()
            )
            and again["weights"]["a"].dtype == torch.float32
            and again["optimizer"]["state"][0]["step"] == 1
            and again["optimizer"]["groups"] == [{"lr": 0.1}, None]
        )

    assert same()
    whole, refused = file.read_bytes(), 0
    for i in range(len(whole)):
        for flip in (1, 32):
            file.write_bytes(whole[:i] + bytes([whole[i] ^ flip]) + whole[i + 1 :])
            try:
                assert same(), i  # a space of the header that is another blank now
            except ValueError as error:
                refused += "state.safetensors" in str(error)
    assert refused > 1.9 * len(whole)
    for data in (whole[:-3], b"", whole[:40], whole + b"0"):
        file.write_bytes(data)
        with pytest.raises(ValueError, match=r"state.safetensors is damaged"):
            state_file.load(file)


def test_a_state_without_checksum_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "state.safetensors"
    save_file({"0": torch.zeros(2)}, file, {"tree": '{"items": [["a", {"tensor": "0"}]]}'})
    with pytest.raises(ValueError, match=r"has no checksum"):
        state_file.load(file)


def interrupted_run(folder: Path, interrupted: Callable[..., Any], **options: Any) -> None:
    with interrupted(pfnn.CorrectorLoss, "forward", 8):
        runs.start("pfnn", {"mode": "offline", **SMALL, **options}, folder, quiet)
    assert (folder / "state.safetensors").exists()


def test_a_state_of_other_options_is_refused(
    tmp_path: Path, interrupted: Callable[..., Any]
) -> None:
    interrupted_run(tmp_path / "run", interrupted)
    file = tmp_path / "run/run.json"
    config = json.loads(file.read_text())
    config["options"]["epochs"] = 5
    file.write_text(json.dumps(config))
    with pytest.raises(ValueError, match=r'state of .*"epochs": 4.*describes .*"epochs": 5'):
        runs.resume(tmp_path / "run", quiet)
    state = state_file.load(tmp_path / "run/state.safetensors")
    config["options"]["epochs"] = 4
    file.write_text(json.dumps(config))
    del state["trainer"]["collector"]
    state_file.save(tmp_path / "run/state.safetensors", state)
    with pytest.raises(ValueError, match=r"state.safetensors does not fit this version's pfnn"):
        runs.resume(tmp_path / "run", quiet)


# ---------------------------------------------------------------- doors


def test_one_process_at_a_time(tmp_path: Path, interrupted: Callable[..., Any]) -> None:
    """The second would write each line of the metrics again."""
    out = tmp_path / "run"
    refused = []

    def second(what: str, done: int, total: int) -> None:
        with pytest.raises(ValueError, match="run is in use: another process trains there"):
            runs.resume(out, quiet)
        refused.append(done)

    (out / ".run.partial-1").mkdir(parents=True)  # of a start that was killed
    weights = runs.start("pfnn", {**SMALL, "epochs": 2}, out, second)
    assert refused == [0, 1, 2]
    assert runs.resume(out, quiet) == weights
    rows = (out / "metrics/scalars/rmse.csv").read_text().splitlines()
    assert len(rows) == 2


def test_nothing_collected_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(EpochCollector, "__iter__", lambda self: iter(()))
    with pytest.raises(ValueError, match="pfnn: no frames were collected, so nothing was learned"):
        runs.start("pfnn", SMALL, tmp_path / "run", quiet)
    assert not (tmp_path / "run/pfnn.safetensors").exists()


def test_weights_that_are_nan_are_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    error = pfnn.CorrectorLoss.error
    monkeypatch.setattr(pfnn.CorrectorLoss, "error", lambda *given: error(*given) * torch.nan)
    with pytest.raises(ValueError, match=r"hidden.weight is NaN or infinite after training"):
        runs.start("pfnn", {**SMALL, "epochs": 1}, tmp_path / "run", quiet)
    assert not (tmp_path / "run/pfnn.safetensors").exists()


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_loses_nothing(
    unbroken: dict[str, bytes], mode: str, tmp_path: Path
) -> None:
    """At a save of the state: no file may grow beyond 500 B. (The kernel's limit, as a full disk's,
    is met at any write.)"""
    out = tmp_path / "run"
    script = f"""if True:
        import resource, sys, torch
        torch.set_num_threads(1)
        from training.cli.command import app
        from coloc_env import state_file
        save = state_file.save
        def full(*arguments):
            resource.setrlimit(resource.RLIMIT_FSIZE, (500, resource.RLIM_INFINITY))
            save(*arguments)
        state_file.save = full
        settings = {[f"--set={key}={value}" for key, value in ({"mode": mode} | SMALL).items()]!r}
        app(["train", "pfnn", *settings, "--out", {str(out)!r}])
    """
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=Path(__file__).parents[3],
        capture_output=True,
        text=True,
        env=environment,
    )
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("error: [Errno 27] File too large: ")
    assert "state.safetensors" in done.stderr
    assert done.stderr.count("\n") == 1
    runs.resume(out, quiet)
    assert outcome(out) == unbroken


def test_damaged_run_files(tmp_path: Path, damaged: Callable[..., Iterator[bytes]]) -> None:
    """One line, or a run like any other."""
    options = SMALL | {"mode": "offline", "learning_rate": 0.01, "seed": 3}
    config = {
        "training": "pfnn",
        "options": options,
        "command": "coloc train pfnn --out run",
        "threads": 1,
        "versions": {"python": "3.11.2"},
    }
    file, known = tmp_path / "run.json", TRAININGS.options_of("pfnn")
    lines, taken = [], 0
    for data in damaged(json.dumps(config), 0, 150):
        file.write_bytes(data)
        try:
            found = runs._config(tmp_path)
        except (ValueError, OSError) as error:
            lines.append(str(error))
        else:
            taken += 1
            assert found["training"] == "pfnn"
            for key, value in found["options"].items():
                assert fits(value, known[key].annotation)
    assert len(lines) > 75
    assert taken > 5
    assert not any("\n" in line for line in lines)
    assert all("run.json" in line for line in lines)


def test_a_byte_order_mark_is_read_over(tmp_path: Path, interrupted: Callable[..., Any]) -> None:
    interrupted_run(tmp_path / "run", interrupted)
    file = tmp_path / "run/run.json"
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    runs.resume(tmp_path / "run", quiet)


def test_more_threads_than_this_machine_has(
    tmp_path: Path, interrupted: Callable[..., Any]
) -> None:
    interrupted_run(tmp_path / "run", interrupted)
    file = tmp_path / "run/run.json"
    config = json.loads(file.read_text())
    file.write_text(json.dumps(config | {"threads": 4000}))
    with pytest.raises(
        ValueError, match=r"run.json: threads 4000 is not allowed: 1 to \d+ on this"
    ):
        runs.resume(tmp_path / "run", quiet)


def test_what_makes_no_training_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TRAININGS._registered, "none", lambda: None)
    with pytest.raises(ValueError, match="none: a Training is needed, not NoneType"):
        runs.start("none", {}, tmp_path / "run", lambda *_: None)
    assert not (tmp_path / "run").exists()
