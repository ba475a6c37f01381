"""Figures: all of them, for good and hopeless agents, with gaps and without anything to show."""

import dataclasses
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import torch
from PIL import Image

from coloc_env.bounds import Bound
from training.evaluation.figures import consistency, draw, error_over_time, trajectories
from training.evaluation.files import FIGURES
from training.evaluation.record import RunRecord, Worlds
from training.evaluation.results import Evaluation


def bounded(results: Evaluation) -> Evaluation:
    mse = torch.full(results.worlds.scored.shape, 0.01, dtype=torch.float64)
    return dataclasses.replace(
        results, bound=Bound(mse, torch.from_numpy(results.worlds.scored), 0.1)
    )


@pytest.mark.filterwarnings("error")
def test_all_figures(made_up: Evaluation, tmp_path: Path) -> None:
    before = dict(mpl.rcParams)
    draw(bounded(made_up), tmp_path, FIGURES)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(FIGURES)
    for name in FIGURES:
        with Image.open(tmp_path / name) as image:
            assert image.width > 800
            assert len(np.unique(np.asarray(image.convert("L")))) > 20
    assert dict(mpl.rcParams) == before


def test_one_step_one_run_one_agent(made_up: Evaluation, tmp_path: Path) -> None:
    agent = made_up.agents["bad"]
    worlds = Worlds(
        made_up.seed,
        made_up.worlds.truth[:1, :1],
        made_up.worlds.attitude[:1],
        made_up.worlds.scored[:1, :1],
    )
    few = (agent.offset[:1, :1], agent.error[:1, :1], agent.nees[:1, :1], agent.broken[:1])
    scenario = dataclasses.replace(made_up.scenario, horizon=1)
    small = Evaluation(scenario, worlds, None, {"bad": RunRecord(worlds, *few)})
    draw(small, tmp_path, FIGURES)


def test_nothing_to_show(made_up: Evaluation, tmp_path: Path) -> None:
    nothing = np.zeros_like(made_up.worlds.scored)
    worlds = dataclasses.replace(made_up.worlds, scored=nothing)
    draw(dataclasses.replace(made_up, worlds=worlds), tmp_path, FIGURES)


def test_lines_show_the_numbers(made_up: Evaluation) -> None:
    results = bounded(made_up)
    good, _, bound = (line.get_ydata() for line in error_over_time(results).axes[0].lines)
    error, scored = results.agents["good:weights=a/b"].error, results.worlds.scored
    assert np.asarray(good)[0] == pytest.approx(np.sqrt((error[:, 0] ** 2).mean()))
    assert np.asarray(good)[6] == pytest.approx(np.sqrt((error[1, 6] ** 2).mean()))
    np.testing.assert_allclose(np.asarray(bound, float), 0.1)
    lines = consistency(results).axes[0].lines
    nees = results.agents["good:weights=a/b"].nees
    assert np.asarray(lines[0].get_ydata())[25] == pytest.approx(nees[:, 25, 1:].mean())
    track = trajectories(results).axes[0].lines[0]
    np.testing.assert_array_equal(np.isnan(np.asarray(track.get_xdata(), float)), ~scored[0, :, 0])
