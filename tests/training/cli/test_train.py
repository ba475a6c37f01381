"""coloc train."""

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from training.cli.command import app

SMALL = ["--set", "scenario=indoor-v0:n_uavs=2:horizon=20", "--set", "worlds=1"]
SMALL += ["--set", "epochs=1", "--set", "score_runs=1"]


def train(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["train", *map(str, arguments)])


def test_teaches() -> None:
    assert "pfnn" in train().stdout
    shown = train("pfnn").stdout
    assert "learning_rate" in shown
    assert "one of offline, online" in shown
    assert "coloc train --resume" in train("--help").stdout


def test_trains_resumes_and_serves(tmp_path: Path) -> None:
    out = tmp_path / "run"
    done = train("pfnn", "--out", out, *SMALL)
    assert done.exit_code == 0, done.output
    assert done.stdout == f"weights written to {out / 'pfnn.safetensors'}\n"
    assert done.stderr == ""
    assert train("--resume", out).stdout == done.stdout
    arguments = ["indoor-v0", "--out", tmp_path / "results", "--runs", 1, "--no-figures"]
    agent = f"pfnn:weights={out / 'pfnn.safetensors'}"
    arguments += ["--agents", agent, "--set", "n_uavs=2", "--set", "horizon=12", "--no-bound"]
    served = CliRunner().invoke(app, ["evaluate", *map(str, arguments)])
    assert served.exit_code == 0, served.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["pfnm", "--out", "x"], "did you mean 'pfnn'"),
        (["pfnm"], "did you mean 'pfnn'"),
        (["pfnn", "--out", "x", "--set", "epochs"], "key=value"),
        (["pfnn", "--out", "x", "--set", "epochs=many"], "a whole number is needed"),
        (["pfnn", "--set", "epochs=3"], "--out DIR is needed"),
        (["pfnn", "--out", "x", "--threads", "0"], "--threads 0"),
        (["--resume", "no/where"], "no/where holds no run"),
        (["pfnn", "--resume", "no/where"], "--resume goes alone"),
    ],
)
def test_one_clear_line(
    arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = train(*arguments)
    assert done.exit_code == 2
    assert words in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
