"""The coloc command: what it writes and prints, and one clear line for whatever is wrong."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from types import ModuleType
from unittest.mock import MagicMock

import pytest
from PIL import Image
from typer.testing import CliRunner, Result

from training.cli.command import app
from training.cli.render import _pace
from training.cli.terminal import progress
from training.evaluation.evaluate import split_agents
from training.evaluation.files import FIGURES, VECTORS, WRITTEN
from training.reproduce.study import STUDIES

SMALL = ["--set", "n_uavs=2", "--set", "horizon=12"]
CHECKOUT = Path(__file__).parents[3]


def coloc(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, list(map(str, arguments)))


def evaluate(out: Path, *arguments: str) -> Result:
    return coloc("evaluate", "indoor-v0", "--out", out, "--runs", "2", *SMALL, *arguments)


def test_evaluate(tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = evaluate(out, "--agents", "test_still,test_still:offset=0.5", "--seed", "5")
    assert done.exit_code == 0, done.output
    assert sorted(path.name for path in out.iterdir()) == sorted(WRITTEN)
    summary = json.loads((out / "results.json").read_text())
    assert summary["overrides"] == {"n_uavs": 2, "horizon": 12}
    assert (summary["seed"], summary["runs"], summary["steps"]) == (5, 2, 12)
    assert list(summary["agents"]) == ["test_still", "test_still:offset=0.5"]
    assert "test_still:offset=0.5" in done.stdout
    assert f"written to {out}" in done.stdout
    assert done.stderr == ""
    again = evaluate(out, "--agents", "test_still", "--no-figures", "--no-bound")
    assert again.exit_code == 0
    assert sorted(path.name for path in out.iterdir()) == sorted(set(WRITTEN) - set(FIGURES))
    assert json.loads((out / "results.json").read_text())["bound"] == {"rmse": None}
    drawn = evaluate(out, "--agents", "test_still", "--vector", "--no-bound")
    assert drawn.exit_code == 0
    there = sorted(path.name for path in out.iterdir())
    assert there == sorted({*WRITTEN, *VECTORS} - set(FIGURES))
    assert "<svg" in (out / VECTORS[0]).read_text()


def test_what_raises_is_reported(tmp_path: Path) -> None:
    done = evaluate(tmp_path / "out", "--agents", "test_still:wrong=raises", "--no-figures")
    assert done.exit_code == 0
    assert done.stderr == (
        "warning: test_still:wrong=raises raised in 2 of 2 runs; "
        "first at step 0: RuntimeError: the matrix is singular\n"
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["evaluate", "indor-v0", "--agents", "ekf"], "did you mean 'indoor-v0'"),
        (["evaluate", "indoor-v0", "--agents", "ekff"], "did you mean 'ekf'"),
        (["evaluate", "indoor-v0", "--agents", "ekf:robst=huber"], "did you mean 'robust'"),
        (["evaluate", "indoor-v0", "--agents", ","], "at least one"),
        (["evaluate", "indoor-v0", "--agents", "ekf", "--set", "landmark=3"], "'landmarks'"),
        (["evaluate", "indoor-v0", "--agents", "ekf", "--set", "dt=0"], "dt"),
        (["evaluate", "indoor-v0", "--agents", "ekf", "--set", "dt"], "key=value"),
        (["evaluate", "indoor-v0", "--agents", "ekf", "--runs", "0"], "runs=0"),
        (["evaluate", "indoor-v0", "--agents", "ekf", "--threads", "0"], "--threads 0"),
        (["evaluate", "indoor-v0", "--agents", "ekf", "--threads", "100000"], "--threads 100000"),
        (["evaluate", "indoor-v0", "--agents", "ekf", "--seed", "-1"], "--seed -1"),
        (["render", "indoor-v0", "--seed", "-1"], "--seed -1"),
        (["render", "indoor-v0", "--seed", str(2**64)], f"--seed {2**64}"),
        (["evaluate", "replay-mrclam-v0", "--agents", "ekf", "--data", "/no/where"], "/no/where"),
        (["render", "indoor-v0", "--steps", "0"], "--steps 0"),
        (["render", "indoor-v0", "--steps", "2000"], "1 to 1000"),
        (["render", "indoor-v0", "--agent", "ekff"], "did you mean 'ekf'"),
        (["scenarios", "indor-v0"], "did you mean 'indoor-v0'"),
        (["agents", "ekff"], "did you mean 'ekf'"),
        (["recordings", "--agents", "ekf", "--only", "mrclan"], "did you mean 'mrclam'"),
    ],
)
def test_one_clear_line(
    arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLOC_DATA", str(tmp_path))
    if arguments[0] in ("evaluate", "render"):
        arguments = [*arguments, "--out", str(tmp_path / "deep" / "out.gif")]
    done = coloc(*arguments)
    assert done.exit_code == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert words in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_output_is_checked_before_anything_is_computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "training.evaluation.evaluate.evaluate", lambda *_, **__: pytest.fail("computed")
    )
    (tmp_path / "file").touch()
    done = evaluate(tmp_path / "file" / "out", "--agents", "ekf")
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr == f"error: {tmp_path / 'file'} is not a folder\n"
    done = coloc("render", "indoor-v0", "--out", tmp_path / "file" / "a.gif")
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
    (tmp_path / "link").symlink_to(tmp_path / "file" / "nowhere")
    done = evaluate(tmp_path / "link", "--agents", "ekf")
    assert (done.exit_code, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    monkeypatch.setattr("training.evaluation.score.score", lambda *_: pytest.fail("computed"))
    inside = tmp_path / "file" / "a.json"
    done = coloc("score", "survey-v0", "--policy", "random", "--out", inside)
    assert (done.exit_code, done.stderr) == (2, f"error: {tmp_path / 'file'} is not a folder\n")
    monkeypatch.setattr("training.evaluation.recordings.recorded", lambda: pytest.fail("computed"))
    done = coloc("recordings", "--agents", "ekf", "--out", inside)
    assert (done.exit_code, done.stderr) == (2, f"error: {tmp_path / 'file'} is not a folder\n")
    if os.geteuid():  # root may write anywhere
        (tmp_path / "closed").mkdir(mode=0o500)
        done = evaluate(tmp_path / "closed", "--agents", "ekf")
        assert (done.exit_code, done.stdout) == (2, "")
        assert "cannot be written" in done.stderr


@pytest.mark.parametrize(
    "where",
    [
        "training.evaluation.evaluate.evaluate",
        "training.evaluation.files.write",
        "training.evaluation.files.write_figures",
    ],
)
def test_an_interruption_leaves_nothing(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(where, interrupt)
    done = evaluate(tmp_path / "deep" / "out", "--agents", "test_still", "--no-bound")
    assert (done.exit_code, done.stderr) == (130, "interrupted\n")
    assert ("test_still" in done.stdout) == (where != "training.evaluation.evaluate.evaluate")
    assert list(tmp_path.iterdir()) == []


def test_a_report_that_cannot_be_written_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("training.evaluation.report.page.page", full)
    done = evaluate(tmp_path / "out", "--agents", "test_still", "--no-bound", "--report")
    assert done.exit_code == 1
    assert "no report could be drawn: [Errno 28] No space left on device" in done.stderr
    assert {path.name for path in (tmp_path / "out").iterdir()} == set(WRITTEN)


def test_a_report_is_written_beside_the_results(tmp_path: Path) -> None:
    done = evaluate(tmp_path / "out", "--agents", "test_still", "--no-figures", "--report")
    assert done.exit_code == 0, done.output
    assert "test_still" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_a_full_disk_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("training.evaluation.files.write", full)
    done = evaluate(tmp_path / "out", "--agents", "test_still", "--no-bound")
    assert done.exit_code == 2
    assert "RMSE" in done.stdout
    assert done.stderr == f"error: [Errno 28] No space left on device: '{tmp_path / 'out'}'\n"
    assert list(tmp_path.iterdir()) == []


def test_results_are_kept_where_figures_cannot_be_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from training.evaluation import figures

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(figures, "consistency", full)
    done = evaluate(tmp_path / "out", "--agents", "test_still", "--no-bound")
    assert done.exit_code == 1
    assert "RMSE" in done.stdout
    assert done.stderr == ("error: no figures could be drawn: [Errno 28] No space left on device\n")
    assert {path.name for path in (tmp_path / "out").iterdir()} == set(WRITTEN) - set(FIGURES)


def test_one_agents_error_does_not_end_the_others(tmp_path: Path) -> None:
    names = "test_still:wrong=missing,test_still"
    done = evaluate(tmp_path / "out", "--agents", names, "--no-bound")
    assert done.exit_code == 1
    assert done.stderr == (
        "error: test_still:wrong=missing has no results: NotImplementedError: not there yet\n"
    )
    assert {path.name for path in (tmp_path / "out").iterdir()} == set(WRITTEN)
    agents = json.loads((tmp_path / "out" / "results.json").read_text())["agents"]
    assert list(agents) == ["test_still", "test_still:wrong=missing"]
    lost = agents["test_still:wrong=missing"]
    assert list(lost) == list(agents["test_still"])
    assert lost.pop("diagnostics") == {"error": "NotImplementedError: not there yet"}
    assert lost.pop("per_uav_rmse") == [None, None]
    assert set(lost.values()) == {None}
    assert "`test_still:wrong=missing` ended in an error" in (tmp_path / "out/table.md").read_text()


def test_an_agent_that_does_not_serve_the_team_does_not_end_the_others(tmp_path: Path) -> None:
    """``emvf`` where nothing is measured; a misspelt one beside it refuses everything at once."""
    few = ("--set", "landmarks=0", "--no-bound", "--no-figures")
    done = evaluate(tmp_path / "out", "--agents", "emvf,hpff,test_still", *few)
    why = "emvf: what the team measures with Ranging would be ignored"
    also = "hpff: the team has no distances to anchors to judge its filter by"
    assert done.exit_code == 1
    lines = done.stderr.splitlines()
    assert lines[0].startswith(f"error: emvf has no results: {why}")
    assert lines[1:] == [f"error: hpff has no results: {also}"]
    agents = json.loads((tmp_path / "out" / "results.json").read_text())["agents"]
    assert agents["test_still"]["rmse"] is not None
    assert agents["emvf"]["rmse"] is None
    assert agents["emvf"]["diagnostics"]["error"].startswith(why)
    for wrong in ("emvf,ekff", "emvf,test_still:wrng=nan", "emvf", "emvf,pfnn:weights=non"):
        done = evaluate(tmp_path / "none", "--agents", wrong, *few)
        assert (done.exit_code, done.stdout, done.stderr.count("\n")) == (2, "", 1)
        assert not (tmp_path / "none").exists()


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "training.cli.command", *arguments]


@pytest.mark.parametrize("encoding", ["latin-1", "cp1252", "ascii"])
def test_a_terminal_that_cannot_show_everything(encoding: str) -> None:
    environment = os.environ | {"PYTHONPATH": str(CHECKOUT), "PYTHONIOENCODING": encoding}
    for arguments in (["scenarios", "indoor-v0"], ["evaluate", "--help"], ["agents", "≥"]):
        done = subprocess.run(command(*arguments), env=environment, capture_output=True)
        assert done.returncode == (2 if "≥" in arguments else 0), done.stderr
        assert b"Traceback" not in done.stderr


def test_results_are_kept_where_nobody_reads_the_table(tmp_path: Path) -> None:
    arguments = ["evaluate", "indoor-v0", "--agents", "dead_reckoning", "--runs", "1", *SMALL]
    arguments += ["--no-figures", "--no-bound", "--out", str(tmp_path / "out")]
    environment = os.environ | {"PYTHONPATH": str(CHECKOUT), "MPLBACKEND": "module://no_such"}
    process = subprocess.Popen(
        command(*arguments), env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == b""
    process.wait(timeout=60)
    assert (tmp_path / "out" / "results.json").exists()


@pytest.mark.parametrize(("name", "frames"), [("a.gif", 3), ("a.png", 1)])
def test_render(name: str, frames: int, tmp_path: Path) -> None:
    out = tmp_path / name
    done = coloc("render", "indoor-v0", "--agent", "test_still", "--steps", "3", "--out", out)
    assert done.exit_code == 0, done.output
    with Image.open(out) as image:
        assert getattr(image, "n_frames", 1) == frames
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    ("steps", "dt", "speed", "every", "hundredths"),
    [(20, 0.1, 1.0, 1, 10), (20, 0.1, 0.5, 1, 20), (20, 0.1, 5.0, 1, 2), (30, 0.1, 3.0, 3, 10)],
)
def test_animations_keep_their_speed(
    steps: int, dt: float, speed: float, every: int, hundredths: int
) -> None:
    assert _pace(steps, dt, speed) == (every, pytest.approx(100 / hundredths))


def test_an_animation_of_a_speed_and_a_size(tmp_path: Path) -> None:
    out, rest = tmp_path / "a.gif", ("--steps", "4", "--speed", "10", "--width", "300", *SMALL)
    done = coloc("render", "indoor-v0", "--agent", "test_still", "--out", out, *rest)
    assert done.exit_code == 0, done.output
    with Image.open(out) as image:
        assert (image.size, image.n_frames, image.info["duration"]) == ((300, 187), 2, 20)


def test_in_ci_a_task_that_is_done_is_a_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for there in (True, False):
        monkeypatch.setenv("CI", "true" if there else "")
        with progress() as bars:
            for done in (1, 2, 2):
                bars("ekf", done, 2)
            bars("map", 1, 2)
        said = capsys.readouterr().err
        assert said.startswith("ekf: 2 done, ") if there else said == ""
        assert said.count("\n") == there


def test_where_nobody_sees_bars_half_a_minute_without_a_line_is_the_longest(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CI", "")
    now = [0.0]
    monkeypatch.setattr("training.cli.terminal.time.monotonic", lambda: now[0])
    with progress() as bars:
        for done in range(1, 10):
            now[0] += 10.0
            bars("ekf", done, 9)
    assert capsys.readouterr().err == "ekf: 4 of 9 done, 40.0 s\nekf: 8 of 9 done, 80.0 s\n"


def test_in_a_notebook_bars_are_a_widget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    widgets = ModuleType("ipywidgets")
    display = ModuleType("IPython.display")  # the real one, outside a notebook, prints
    for stands_in in (widgets, ModuleType("IPython"), display):
        monkeypatch.setitem(sys.modules, stands_in.__name__, stands_in)
    monkeypatch.setattr(display, "display", MagicMock(), raising=False)
    shown = MagicMock()
    monkeypatch.setattr(widgets, "Output", shown, raising=False)
    with progress() as bars:
        bars("ekf", 1, 2)
    assert shown.called


def test_lists() -> None:
    assert "indoor-v0" in coloc("scenarios").stdout
    settings = coloc("scenarios", "indoor-v0").stdout
    assert "landmark_radius" in settings
    assert "30.0,20.0,5.0" in settings
    agents = coloc("agents").stdout
    assert "test_still" in agents.partition("your own")[2]
    assert "ekf" in agents.partition("Kalman filters")[2].partition("particle filters")[0]
    options = coloc("agents", "test_still").stdout
    assert "offset" in options
    assert "a number" in options
    assert "(frontier)" in coloc("tasks").stdout
    assert "frontier" in coloc("tasks", "survey-v0").stdout


@pytest.mark.parametrize(
    ("text", "agents"),
    [
        ("ekf,pf500", ["ekf", "pf500"]),
        (" ekf , pf500 ,", ["ekf", "pf500"]),
        ("apf:bounds=100,800:start=300,ekf", ["apf:bounds=100,800:start=300", "ekf"]),
        ("a:x=-1,-2,.5,b", ["a:x=-1,-2,.5", "b"]),
        ("", []),
    ],
)
def test_split_agents(text: str, agents: list[str]) -> None:
    assert split_agents(text) == agents


def test_help_teaches_and_is_instant() -> None:
    heavy = "{'torch', 'matplotlib'}"
    code = f"import sys, training.cli.command; assert not {heavy} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=CHECKOUT)
    for command in ("evaluate", "render"):
        assert f"coloc {command} indoor-v0 --agent" in coloc(command, "--help").stdout
    assert "coloc scenarios" in coloc("--help").stdout


def test_ctrl_c_in_a_real_process(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "training.cli.command", "evaluate", "indoor-v0"]
    command += ["--agents", "dead_reckoning", "--no-bound", "--out", str(tmp_path / "deep" / "out")]
    environment = os.environ | {"PYTHONPATH": str(CHECKOUT)}
    listening = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # which shells' jobs are not
    process = subprocess.Popen(
        command, env=environment, cwd=tmp_path, stderr=subprocess.PIPE, preexec_fn=listening
    )
    try:
        for _ in range(600):
            time.sleep(0.05)
            if (tmp_path / "deep").exists():
                break
        time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=120)
    finally:
        process.kill()
    assert (process.returncode, errors) == (130, b"interrupted\n")
    assert list(tmp_path.iterdir()) == []


def test_reproduces_help_names_every_part() -> None:
    text = coloc("reproduce", "--help").stdout
    for key in STUDIES:
        for part in STUDIES[key]().parts:
            assert part in text, (key, part)
