"""``coloc view``: what it writes, and what it refuses in one line."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from training.cli.command import app


def test_a_scenario_is_written(tmp_path: Path) -> None:
    out = tmp_path / "room.rrd"
    words = ["view", "indoor-v0", "--set", "n_uavs=2", "--agent", "ekf", "--steps", "3"]
    done = CliRunner().invoke(app, [*words, "--no-open", "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert out.stat().st_size > 1000


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("{file}",), "is a file: a scenario's name or the folder of an evaluation"),
        (("indoor-v0", "--steps", "0"), "--steps 0 is not allowed: 1 to 1000"),
        (("indoor-v0", "--out", "x.png"), "--out x.png is not allowed: a name ending in .rrd"),
        (("{empty}",), "results.json"),
        (("{empty}", "--agent", "ekf"), "--agent is for a scenario"),
        (("{empty}", "--set", "nlos=0.1"), "--set is for a scenario"),
        (("{empty}", "--seed", "0"), "--seed is for a scenario"),
    ],
)
def test_bad_words_are_refused(tmp_path: Path, words: tuple[str, ...], message: str) -> None:
    file, empty = tmp_path / "flight.csv", tmp_path / "empty"
    file.write_text("x")
    empty.mkdir()
    chosen = [word.format(file=file, empty=empty) for word in words]
    done = CliRunner().invoke(app, ["view", *chosen])
    assert done.exit_code == 2
    assert message in done.output
    assert len(done.output.strip().splitlines()) == 1
    assert not list(tmp_path.glob("*.rrd"))
