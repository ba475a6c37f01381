"""``coloc recording``: from a folder or a bag to what evaluation takes."""

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from tests.coloc_env.datasets.folders_made import spreadsheet, write
from tests.coloc_env.scenarios.test_replay_own import wheeled_team
from training.cli.command import app


def coloc(*words: str) -> Result:
    return CliRunner().invoke(app, list(words))


@pytest.fixture
def circles(tmp_path: Path) -> Path:
    from coloc_env.datasets.open_format import write_recording

    write_recording(wheeled_team(), tmp_path / "circles")
    return tmp_path / "circles"


def test_check_says_what_is_there_and_draws_it(circles: Path, tmp_path: Path) -> None:
    done = coloc("recording", "check", str(circles), "--picture", str(tmp_path / "p.png"))
    assert done.exit_code == 0, done.output
    assert "ann/anchor_0" in done.stdout
    assert "anchor_ranges: stamps are +0.1" in done.output
    assert (tmp_path / "p.png").stat().st_size > 10_000


def test_calibrate_writes_what_replay_believes(circles: Path) -> None:
    done = coloc("recording", "calibrate", str(circles), "--span", "0:8")
    assert done.exit_code == 0, done.output
    text = (circles / "believed.yaml").read_text()
    assert text.startswith("# circles: calibrated on 0:8 s of it")
    from coloc_env import make_scenario

    make_scenario("replay-v0", path=str(circles), believed=str(circles / "believed.yaml"))


def test_tuning_says_what_it_gains(circles: Path) -> None:
    line = ("recording", "calibrate", str(circles), "--span", "0:6", "--tune", "ekf")
    done = coloc(*line)
    assert done.exit_code == 0, done.output
    assert "ekf on the part learnt from" in done.stdout


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (("check", "/nowhere"), "error: /nowhere: no such folder"),
        (("calibrate", "FOLDER", "--span", "5"), "error: --span 5 is not allowed: FROM:TO in s"),
        (("export", "replay-x-v0", "--out", "x"), "error: unknown recording 'replay-x-v0'"),
        (("import", "/none.bag"), "error: --map and --out are needed (or --list)"),
    ],
)
def test_refusals_are_one_line(line: tuple[str, ...], words: str, circles: Path) -> None:
    done = coloc("recording", *(str(circles) if word == "FOLDER" else word for word in line))
    assert done.exit_code == 2
    assert words in done.output
    assert len(done.output.strip().splitlines()) == 1


def test_trajectories_of_a_folder_are_exported(circles: Path, tmp_path: Path) -> None:
    for kind, made in (("tum", "*.txt"), ("bag", "trajectories/*.mcap"), ("open", "*/truth.csv")):
        out = tmp_path / kind
        done = coloc("recording", "export", str(circles), "--format", kind, "--out", str(out))
        assert done.exit_code == 0, done.output
        assert list(out.glob(made))


def test_a_spreadsheets_folder_is_checked(tmp_path: Path) -> None:
    done = coloc("recording", "check", str(write(tmp_path, spreadsheet())))
    assert done.exit_code == 0, done.output
    assert "not used: column note" in done.output
