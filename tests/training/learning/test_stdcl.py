"""Training of learned factors: it starts at map, moves, and anneals."""

import itertools
import json
from pathlib import Path
from typing import Any

import pytest
import torch

from agents.stdcl.factors.network import FactorNetwork
from agents.weights import learned, untrained
from training.evaluation.evaluate import silent
from training.learning import run
from training.learning.stdcl import stdcl
from training.learning.through_time import far_off

TINY: dict[str, Any] = {
    "scenario": "swarm-v0:n_uavs=8:size=3400,3400,1700:horizon=6:comm_radius=2500",
    "variants": "nlos=0.3/ins_bias=1",
    "worlds": 2,
    "steps": 3,
    "score_runs": 0,
}


def test_pseudo_huber_is_square_near_and_linear_far() -> None:
    error = torch.tensor([1e-3, 0.1, 1e4], dtype=torch.float64)
    found = far_off(error.square())
    torch.testing.assert_close(found[:2], error[:2].square(), rtol=1e-3, atol=0)
    assert float(found[2] / error[2]) == pytest.approx(6.0, rel=1e-3)


def test_a_training_moves_the_network_and_writes_its_card(tmp_path: Path) -> None:
    weights = run.start("stdcl", TINY, tmp_path / "run", silent)
    trained, new = learned(FactorNetwork, weights), untrained(FactorNetwork, 0)
    assert not torch.equal(trained.link_out.weight, new.link_out.weight)
    assert not torch.equal(trained.node_out.bias, new.node_out.bias)
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["training"] == "stdcl"
    assert card["metrics"]["optim_steps"] == 4


def test_the_rate_falls_along_a_cosine() -> None:
    training = stdcl(**TINY)
    optimizer = training.trainer.optimizer  # type: ignore[attr-defined]
    rates = [optimizer.param_groups[0]["lr"] for _ in training.collector]  # type: ignore[attr-defined]
    assert rates[0] == pytest.approx(3e-3)
    assert all(a > b for a, b in itertools.pairwise(rates))
    assert rates[2] == pytest.approx(0.5 * (3e-3 + 1e-4))


def test_batches_longer_than_an_episode_are_refused() -> None:
    with pytest.raises(ValueError, match="steps=12 is not allowed"):
        stdcl(**{**TINY, "steps": 12})
