"""How far constants carry."""

from functools import partial

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from agents.registry import make
from coloc_env.scenarios import make_scenario
from training.cli.command import app
from training.evaluation import constants
from training.evaluation.constants import Found, bank_constants, bias_constants, measure, table


def test_constants_are_built_and_differ() -> None:
    scenario = make_scenario("indoor-v0")
    banks = [make(one.agent, scenario).options for one in bank_constants()]
    assert len(set(banks)) == len(banks)
    chosen = [tuple(one.overrides["hanyang"].values()) for one in bias_constants()]
    assert len(set(chosen)) == len(chosen)
    assert chosen[0] == (0.1, 100.0)
    assert bias_constants()[0].overrides["mrclam"] == {"sighting_bias": 0.5, "bias_time": 100.0}


def test_the_table_chooses_by_scores_and_shows_figures() -> None:
    found = {
        "a": {"old": Found(1.0, 6.0), "new": Found(0.5, 3.0)},
        "b": {"old": Found(0.1, 4.0), "new": Found(0.4, 9.0)},
    }
    rows = table("biases", found, "command", "here")["rows"]
    assert rows == [
        ["a", "old", "6", "6", "3 (new)", "6 (old)", "0.500"],
        ["b", "new", "9", "4", "4 (old)", "9 (new)", "0.300"],
    ]


def test_likelihood_is_scipys(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of positions under the estimates' covariances; a bank's score is the ratio to Huber's."""
    stats = pytest.importorskip("scipy.stats")
    world = "replay", partial(make_scenario, "indoor-v0", horizon=3, n_uavs=2), torch.tensor([3])
    monkeypatch.setattr(constants, "_worlds", lambda *_: iter([world]))
    monkeypatch.setattr(constants, "bias_constants", lambda: bias_constants()[:2])
    monkeypatch.setattr(constants, "bank_constants", lambda: bank_constants()[:2])
    found = measure("biases")["replay"]
    run = constants.record(make(constants.HUBER, world[1]()), world[1](), world[2])
    densities = [
        stats.multivariate_normal(cov=p).logpdf(e)
        for e, p in zip(run.offset[0].reshape(-1, 3), run.covariance.reshape(-1, 3, 3), strict=True)
    ]
    assert {one.score for one in found.values()} == {found["0.1 m, 100 s"].score}
    assert found["0.1 m, 100 s"].score == pytest.approx(-np.mean(densities), rel=1e-4)
    assert measure("bank")["replay"]["as shipped"].figure == pytest.approx(1.0, abs=0.2)


def test_what_is_not_allowed() -> None:
    done = CliRunner().invoke(app, ["recordings", "--constants", "pi"])
    assert done.exit_code == 2
    assert "--constants pi is not allowed: bank or biases" in done.stderr
