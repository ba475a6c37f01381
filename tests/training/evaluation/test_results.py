"""What is written: strict JSON, CSV, Markdown and TUM files."""

import csv
import dataclasses
import io
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from coloc_env.geometry import rotation_matrix
from training.evaluation.files import FIGURES, WRITTEN, write
from training.evaluation.results import Evaluation
from training.evaluation.tables import COLUMNS, csv_text, markdown, rows
from training.evaluation.tum import folder_names, quaternions, tum_text


def refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is not JSON")


def unscored(results: Evaluation) -> Evaluation:
    """The same with nothing to score."""
    nothing = np.zeros_like(results.worlds.scored)
    return dataclasses.replace(results, worlds=dataclasses.replace(results.worlds, scored=nothing))


def test_folder(made_up: Evaluation, tmp_path: Path) -> None:
    write(made_up, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == set(WRITTEN) - set(FIGURES)
    text = (tmp_path / "results.json").read_text(encoding="utf-8")
    summary = json.loads(text, parse_constant=refuse)
    assert summary == made_up.summary
    assert summary["overrides"] == {"room": [10.0, 10.0], "walls": None}
    assert summary["bound"] == {"rmse": None}
    assert summary["agents"]["bad"]["diverged_runs"] == 2
    assert summary["agents"]["good:weights=a/b"]["diverged_runs"] == 0


def test_what_is_not_finite_is_null(made_up: Evaluation) -> None:
    nothing = unscored(made_up)
    figures = json.loads(json.dumps(nothing.summary, allow_nan=False))["agents"]["bad"]
    assert figures["rmse"] is None
    assert figures["median"] is None
    assert figures["per_uav_rmse"] == [None, None, None]
    assert figures["diagnostics"]["ate"] is None
    assert figures["diverged_runs"] == 0


def test_csv(made_up: Evaluation) -> None:
    lines = list(csv.DictReader(io.StringIO(csv_text(made_up))))
    assert [line["agent"] for line in lines] == list(made_up.agents)
    for line in lines:
        figures = made_up.summary["agents"][line["agent"]]
        assert float(line["rmse"]) == figures["rmse"]
        assert line["rmse_after_10s"] == ""
        assert float(line["rmse_uav_2"]) == figures["per_uav_rmse"][2]
        assert float(line["ate"]) == figures["diagnostics"]["ate"]


def test_markdown(made_up: Evaluation) -> None:
    text = markdown(made_up)
    assert text.startswith("# made-up: 2 runs of 30 steps of 0.1 s, seeds 7 to 8\n")
    tables = [line for line in text.splitlines() if line.startswith("|")]
    assert {line.count("|") for line in tables} == {len(COLUMNS) + 2, 4}
    assert "`room=10.0,10.0`, `walls=none`" in text
    assert "RMSE minus that of `good:weights=a/b`" in text
    assert rows(made_up, ["rmse_after_10s", "ms_per_step"])[0][1:] == ["–", "1.5"]


def test_a_method_that_raises_is_named(made_up: Evaluation) -> None:
    bad = dataclasses.replace(made_up.agents["bad"], messages=("step 3: it broke",))
    named = dataclasses.replace(made_up, agents={"bad": bad})
    assert "`bad` raised in 1 of 2 runs; the first at step 3: it broke" in markdown(named)


def test_tum_files_hold_scored_steps(made_up: Evaluation, tmp_path: Path) -> None:
    write(made_up, tmp_path)
    folders = ["bad", "good-weights=a_b", "groundtruth"]
    assert sorted(path.name for path in (tmp_path / "tum").iterdir()) == folders
    dim = made_up.scenario.arena.dim
    for i in range(3):
        now = made_up.worlds.scored[0, :, i]
        for folder, name in zip(folders, ("bad", "good:weights=a/b", None), strict=True):
            table = np.loadtxt(tmp_path / "tum" / folder / f"uav_{i}.txt")
            position = made_up.worlds.truth[0, now, i]
            if name is not None:
                position = position + made_up.agents[name].offset[0, now, i]
            assert table.shape == (now.sum(), 8)
            np.testing.assert_allclose(table[:, 0], np.flatnonzero(now) * 0.1)
            np.testing.assert_allclose(table[:, 1 : 1 + dim], position, rtol=1e-8)
            np.testing.assert_allclose(np.linalg.norm(table[:, 4:], axis=1), 1)
            if name is not None:
                np.testing.assert_array_equal(table[:, 4:], [[0, 0, 0, 1]] * now.sum())


def test_tum_line() -> None:
    text = tum_text(np.array([0.1]), np.array([[1.0, -2.5]]), np.array([[0.0, 0.0, 0.6, 0.8]]))
    assert text == "0.1 1 -2.5 0 0 0 0.6 0.8\n"


def test_attitudes_turn_as_the_worlds_do() -> None:
    heading = np.array([[0.3], [-2.0]])
    x, y, z, w = quaternions(heading).T
    turned = rotation_matrix(torch.from_numpy(np.stack((w, x, y, z), -1)))[:, :2, :2]
    torch.testing.assert_close(turned, rotation_matrix(torch.from_numpy(heading)))
    wxyz = np.array([[0.5, 0.1, 0.7, 0.5]])
    np.testing.assert_array_equal(quaternions(wxyz), [[0.1, 0.7, 0.5, 0.5]])


@pytest.mark.parametrize(
    ("agents", "folders"),
    [
        (["ekf", "ekf:robust=huber"], ["ekf", "ekf-robust=huber"]),
        (["a:b", "a-b", "groundtruth"], ["a-b", "a-b_", "groundtruth_"]),
        (["pfnn:weights=../x y.safetensors"], ["pfnn-weights=.._x_y.safetensors"]),
    ],
)
def test_folder_names(agents: list[str], folders: list[str]) -> None:
    assert folder_names(agents) == folders
