"""``coloc dataset``: what it writes and says."""

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from training.cli.command import app

SMALL = ["--steps", "3", "--set", "n_uavs=2"]


def dataset(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["dataset", *map(str, arguments)])


def test_a_dataset_is_written_and_another_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "made"
    done = dataset("indoor-v0", "--runs", "2", "--agent", "ekf", "--out", out, *SMALL)
    assert done.exit_code == 0, done.output
    assert done.stdout == f"written to {out}: 2 runs in 1 parts\n"
    written = sorted(path.name for path in out.iterdir())
    assert written == ["README.md", "dataset.json", "steps", "tensordict", "worlds"]
    again = dataset("indoor-v0", "--runs", "3", "--agent", "ekf", "--out", out, *SMALL)
    assert again.exit_code == 2
    assert "holds a dataset of runs=2, not 3" in again.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["indor-v0"], "did you mean 'indoor-v0'"),
        (["indoor-v0", "--agent", "ekff"], "did you mean 'ekf'"),
        (["indoor-v0", "--runs", "0"], "--runs 0 is not allowed"),
        (["indoor-v0", "--steps", "9999"], "--steps 9999 is not allowed: 1 to 1000"),
        (["indoor-v0", "--set", "tdoa_anchors=1"], "tdoa_anchors=1 is not allowed"),
        (["indoor-v0", "--seed", "-1"], "--seed -1 is not allowed"),
        (["indoor-v0", "--set", "links=chosen"], "links=chosen is not allowed: nobody chooses"),
    ],
)
def test_what_is_wrong_is_one_line(arguments: list[str], words: str, tmp_path: Path) -> None:
    done = dataset(*arguments, "--out", tmp_path / "x")
    assert done.exit_code == 2
    assert words in done.output
    assert len(done.output.strip().splitlines()) == 1
    assert not (tmp_path / "x").exists()
