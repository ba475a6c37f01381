"""coloc train."""

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from coloc_env.options import typed
from training.cli.command import app
from training.learning.registry import TRAININGS

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


@pytest.mark.parametrize("name", TRAININGS)
def test_lists_every_option_with_what_is_allowed_and_its_default(name: str) -> None:
    shown = train(name).stdout
    for key, option in TRAININGS.options_of(name).items():
        line = [line for line in shown.splitlines() if line.split(" ")[0] == key][-1]
        assert option.words.split(" ")[0] in line
        if isinstance(option.default, int | float):  # texts may be broken into lines
            assert typed(option.default) in line
        if option.annotation is not str:
            assert option.words != "a name"


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


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of libraries, as Python hides them
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["pfnm", "--out", "x"], "did you mean 'pfnn'"),
        (["pfnm"], "did you mean 'pfnn'"),
        (["pfnn", "--out", "x", "--set", "epochs"], "key=value"),
        (
            ["pfnn", "--out", "x", "--set", "epochs=many"],
            "a whole number from 1 to 100000",
        ),
        (["pfnn", "--set", "epochs=3"], "--out DIR is needed"),
        (["pfnn", "--out", "x", "--threads", "0"], "--threads 0 is not allowed: 1 to"),
        (["pfnn", "--out", "x", "--threads", "100000"], "--threads 100000 is not allowed: 1 to"),
        (["trust", "--out", "x", "--set", "steps=101"], "steps=101 is not allowed: at most 100"),
        (["trust", "--out", "x", "--set", "steps=301"], "steps=301 is not allowed: at most 100"),
        (["stdcl", "--out", "x", "--set", "steps=301"], "steps=301 is not allowed: at most 300"),
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
