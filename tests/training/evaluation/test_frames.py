"""Evaluations as pandas and xarray know data."""

import numpy as np
import pytest

from training.evaluation.frames import dataframe, dataset
from training.evaluation.results import Evaluation


def test_dataframe(made_up: Evaluation) -> None:
    frame = dataframe(made_up)
    assert len(frame) == len(made_up.agents) * made_up.worlds.scored.sum()
    for agent, found in frame.groupby("agent"):
        rmse = np.sqrt(np.square(found["error"].astype(float)).mean())
        assert rmse == pytest.approx(made_up.summary["agents"][agent]["rmse"], rel=1e-6)
        assert found["seed"].min() >= made_up.seed
        assert found["time"].max() <= (made_up.scenario.horizon - 1) * made_up.dt + 1e-9


def test_dataset(made_up: Evaluation) -> None:
    data = dataset(made_up)
    apart = np.linalg.norm(data["estimate"] - data["truth"], axis=-1)
    np.testing.assert_allclose(
        apart, [np.linalg.norm(one.offset, axis=-1) for one in made_up.agents.values()], rtol=1e-5
    )
    first = next(iter(made_up.agents))
    kept = data["error"].sel(agent=first).where(data["scored"])
    rmse = float(np.sqrt((kept.astype(float) ** 2).mean()))
    assert rmse == pytest.approx(made_up.summary["agents"][first]["rmse"], rel=1e-6)


def test_notebooks_show_the_table(made_up: Evaluation) -> None:
    text = made_up._repr_html_()
    assert text.startswith("<table>")
    for agent in made_up.agents:
        assert f"<td>{agent}</td>" in text


def test_notebooks_show_a_record(made_up: Evaluation) -> None:
    name, one = next(iter(made_up.agents.items()))
    text = one._repr_html_()
    assert f"<td>{made_up.summary['agents'][name]['rmse']:.3g} m</td>" in text
    assert f"<td>{', '.join(map(str, one.error.shape))}</td>" in text
