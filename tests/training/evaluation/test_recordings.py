"""Faults of recordings must not reach results: what no sensor measured, holes, far origins."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from coloc_env.datasets import DataError, Recording, Table, Track, load
from coloc_env.datasets.recording import near_origin
from coloc_env.scenarios import make_scenario
from tests.sampling import slowly
from training.cli.command import app
from training.evaluation.evaluate import evaluate
from training.evaluation.files import write
from training.evaluation.results import Evaluation

SECOND = 1_000_000_000


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLOC_CACHE", str(tmp_path / "cache"))


def folder_of(dataset: str) -> Path:
    """The dataset's files; where they are missing the test is skipped, but not in CI."""
    from coloc_env.datasets.folders import dataset_folder

    try:
        return dataset_folder(dataset)
    except DataError as error:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(error))


def run(name: str, agent: str = "ekf", runs: int = 2, **overrides: Any) -> Evaluation:
    return evaluate(make_scenario(name, **overrides), [agent], runs, bound=False)


def rmse(results: Evaluation) -> float:
    (metrics,) = results.summary["agents"].values()
    return float(metrics["rmse"])


# ------------------------------------------------------------------ what no sensor measured


@pytest.fixture
def labyrinth(tmp_path: Path) -> Path:
    """A folder of recordings with a copy of TU Chemnitz's that may be changed."""
    home = tmp_path / "data" / "tuc_indoor_uwb"
    shutil.copytree(folder_of("tuc"), home)
    return home / "Indoor_UWB_Input.txt"


def spoil(path: Path, value: str) -> int:
    """Every fifth range replaced; how many."""
    lines, count = path.read_text(encoding="utf-8").splitlines(), 0
    ranges = [i for i, line in enumerate(lines) if line.startswith("range2")]
    for i in ranges[::5]:
        word, time, _, *rest = lines[i].split()
        lines[i] = " ".join((word, time, value, *rest))
        count += 1
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return count


@pytest.mark.parametrize("value", ["-1", "nan", "1000", *slowly("0", "inf", "1e308")])
def test_one_range_in_five_is_none(labyrinth: Path, value: str, tmp_path: Path) -> None:
    data = str(tmp_path / "data")
    before = rmse(run("replay-tuc-v0", data=data))
    count = spoil(labyrinth, value)
    results = run("replay-tuc-v0", data=data)
    assert before < 0.1
    assert rmse(results) < 1.2 * before
    assert results.dropped == {"anchor_ranges": count}
    (metrics,) = results.summary["agents"].values()
    assert metrics["diagnostics"]["dropped_measurements"] == count
    write(results, tmp_path)
    text = f"no sensor can have measured it: {count} of anchor_ranges."
    assert text in (tmp_path / "table.md").read_text(encoding="utf-8")


def test_the_command_mentions_what_is_left_out(labyrinth: Path, tmp_path: Path) -> None:
    count = spoil(labyrinth, "-1")
    arguments = ["evaluate", "replay-tuc-v0", "--agents", "ekf", "--runs", "1", "--no-figures"]
    arguments += ["--no-bound", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "out")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLOC_DATA", "")
        done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0
    assert done.stderr.startswith("note: Left out of the recording, since no sensor can")
    assert f"{count} of anchor_ranges" in done.stderr
    summary = json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))
    assert summary["agents"]["ekf"]["diagnostics"]["dropped_measurements"] == count


def test_changed_files_and_another_folder_are_loaded(
    labyrinth: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLOC_DATA", str(tmp_path / "data"))
    assert run("replay-tuc-v0", runs=1).dropped == {}
    shutil.copytree(tmp_path / "data", tmp_path / "other")
    count = spoil(labyrinth, "-1")
    assert run("replay-tuc-v0", runs=1).dropped == {"anchor_ranges": count}
    monkeypatch.setenv("COLOC_DATA", str(tmp_path / "other"))
    assert run("replay-tuc-v0", runs=1).dropped == {}


# ------------------------------------------------------------------ far origins


def moved(recording: Recording, by: tuple[float, ...]) -> Recording:
    """The recording in a frame whose zero is elsewhere."""
    apart = np.array(by)
    return replace(
        recording,
        truth=tuple(replace(track, position=track.position + apart) for track in recording.truth),
        landmarks=recording.landmarks + apart,
        anchors=recording.anchors + apart,
    )


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch) -> Callable[[Recording], None]:
    """Lets scenarios replay a recording of the test's."""

    def use(recording: Recording) -> None:
        module = "coloc_env.scenarios.parts.replays"
        monkeypatch.setattr(f"{module}._loaded", lambda *_, **__: near_origin(recording))

    return use


def test_map_coordinates_keep_their_digits(
    recorded: Callable[[Recording], None], tmp_path: Path
) -> None:
    folder_of("tuc")
    near = run("replay-tuc-v0")
    utm = (353_017.25, 5_634_012.5)
    recorded(moved(load("tuc"), utm))
    far = run("replay-tuc-v0")
    assert far.origin.tolist() == [353_000.0, 5_634_000.0]
    assert rmse(far) == pytest.approx(rmse(near), rel=0.01)
    write(far, tmp_path)
    for name in ("groundtruth", "ekf"):
        table = np.loadtxt(tmp_path / "tum" / name / "uav_0.txt")
        track = near.worlds.truth[0][near.worlds.scored[0, :, 0], 0]
        assert np.abs(table[:, 1:3] - track - utm).max() < (1e-4 if name == "groundtruth" else 1.0)


# ------------------------------------------------------------------ holes


def holed(recording: Recording, truth: tuple[int, int] | None, imu: tuple[int, int] | None) -> Any:
    """The recording without truth or IMU from … to … s."""

    def kept(time: Any, hole: tuple[int, int] | None) -> Any:
        outside = np.ones(len(time), bool)
        if hole is not None:
            outside = (time <= hole[0] * SECOND) | (time >= hole[1] * SECOND)
        return outside

    tracks = []
    for track in recording.truth:
        there = kept(track.time, truth)
        parts = (track.position, track.attitude, track.velocity, track.gyro_bias, track.accel_bias)
        cut = [None if part is None else part[there] for part in parts]
        tracks.append(Track(track.time[there], *cut))  # type: ignore[arg-type]
    tables = []
    for table in recording.streams["imu"]:
        there = kept(table.time, imu)
        tables.append(Table(table.time[there], table.values[there], table.columns))
    return replace(recording, truth=tuple(tracks), streams={"imu": tuple(tables)})


@pytest.mark.parametrize(("truth", "imu", "limit"), [((20, 23), None, 1.1), (None, (20, 23), 1.3)])
def test_holes_are_not_filled_with_inventions(
    truth: Any, imu: Any, limit: float, recorded: Callable[[Recording], None]
) -> None:
    folder_of("euroc")
    recording, span = load("euroc"), (15.0, 30.0)
    whole = run("replay-euroc-v0", span=span)
    recorded(holed(recording, truth, imu))
    results = run("replay-euroc-v0", span=span)
    assert rmse(results) < limit * rmse(whole)
    (metrics,), (before,) = (one.summary["agents"].values() for one in (results, whole))
    assert metrics["nees"] < 1.3 * before["nees"]
    missing = ~results.worlds.scored[0]
    steps = 0 if truth is None else 30
    assert missing.sum(0).tolist() == pytest.approx([steps] * 3, abs=1)
