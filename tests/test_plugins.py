"""A package of somebody's own, installed, is enough for every command to see what it brings."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
PACKAGE = Path(__file__).parent / "example_package"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a process that finds the example package installed."""
    folder = tmp_path_factory.mktemp("site")
    source = tmp_path_factory.mktemp("source") / "package"
    subprocess.run(["cp", "-r", str(PACKAGE), str(source)], check=True)
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps"]
    command += ["--no-build-isolation", "--no-index", "--target", str(folder), str(source)]
    subprocess.run(command, check=True)
    paths = [str(folder), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}


def coloc(installed: dict[str, str], *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", "from training.cli.command import main; main()", *words],
        env=installed,
        capture_output=True,
        text=True,
    )


EXPLAINED = (
    ("scenarios", "corridor-v0", "UAVs in a corridor of 4 m by 3 m", "length"),
    ("agents", "anchor_mean", "weighted by inverse distance", "nearest"),
    ("train", "offset", "Learns nothing", "epochs"),
)


def test_it_is_listed_and_explained(installed: dict[str, str]) -> None:
    """All in one process: torch takes seconds to import."""
    lines = [words for what, name, *_ in EXPLAINED for words in ([what], [what, name])]
    script = f"""if True:
        import json
        from typer.testing import CliRunner
        from training.cli.command import app
        print(json.dumps([CliRunner().invoke(app, words).output for words in {lines!r}]))
    """
    done = subprocess.run(
        [sys.executable, "-c", script], env=installed, capture_output=True, text=True, check=True
    )
    outputs = iter(json.loads(done.stdout))
    for _, name, summary, option in EXPLAINED:
        assert name in next(outputs)
        explained = next(outputs)
        assert summary in explained
        assert option in explained


def test_it_is_evaluated(installed: dict[str, str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["--agents", "anchor_mean:nearest=2,ekf", "--runs", "2", "--set", "length=20"]
    done = coloc(installed, "evaluate", "corridor-v0", *words, "--no-figures", "--out", str(out))
    assert done.returncode == 0, done.stderr
    figures = json.loads((out / "results.json").read_text())["agents"]
    assert figures["ekf"]["rmse"] < 0.5 < figures["anchor_mean:nearest=2"]["rmse"] < 10


def test_a_sensor_is_used_and_bounded(installed: dict[str, str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = [
        "--agents",
        "dead_reckoning,ekf",
        "--runs",
        "2",
        "--set",
        "horizon=100",
        "--no-figures",
    ]
    done = coloc(installed, "evaluate", "beacon-room-v0", *words, "--out", str(out))
    assert done.returncode == 0, done.stderr
    found = json.loads((out / "results.json").read_text())
    figures = found["agents"]
    assert figures["ekf"]["rmse"] < 0.5 * figures["dead_reckoning"]["rmse"]
    assert 0.8 < figures["ekf"]["rmse"] / found["bound"]["rmse"] < 1.6


def test_what_does_not_fit_is_refused_in_one_line(installed: dict[str, str]) -> None:
    words = ["--agents", "anchor_mean", "--runs", "1", "--out", "nowhere"]
    done = coloc(installed, "evaluate", "indoor-v0", *words)
    assert done.returncode == 2
    assert "anchor_mean: what the team measures with Landmarks, Ranging" in done.stderr
    assert coloc(installed, "train", "offset", "--out", "nowhere").returncode == 2


def test_a_name_that_is_taken_is_an_error(installed: dict[str, str], tmp_path: Path) -> None:
    other = tmp_path / "other-1.0.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (other / "entry_points.txt").write_text("[coloc.localizers]\nekf = somewhere:Ekf\n")
    paths = os.pathsep.join((str(tmp_path), installed["PYTHONPATH"]))
    done = coloc({**installed, "PYTHONPATH": paths}, "agents")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "other brings the agent 'ekf', which exists already" in done.stderr
