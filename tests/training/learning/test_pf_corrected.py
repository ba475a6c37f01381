"""Training of the corrector that sees residuals: it starts at apf, and all of it moves."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from agents.particle.evidence_corrector import EvidenceCorrector
from agents.weights import learned, untrained
from training.evaluation.evaluate import silent
from training.learning import run
from training.learning.pf_corrected import pf_corrected
from training.learning.through_time import run_again

TINY: dict[str, Any] = {
    "scenario": "indoor-v0:n_uavs=2:horizon=6",
    "variants": "landmarks=0:anchors=4/landmarks=2",
    "particles": 20,
    "worlds": 1,
    "steps": 3,
    "score_runs": 0,
    "epochs": 1,
}


def test_a_training_moves_all_of_the_network(tmp_path: Path) -> None:
    weights = run.start("pf_corrected", TINY, tmp_path / "run", silent)
    trained, new = learned(EvidenceCorrector, weights), untrained(EvidenceCorrector, 0)
    for name, parameter in trained.named_parameters():
        assert not torch.equal(parameter, new.get_parameter(name)), name
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["training"] == "pf_corrected"
    assert card["metrics"]["optim_steps"] == 4


def test_the_filter_runs_again_to_the_same_estimates() -> None:
    """With the weights that collected a batch, what the loss runs again is that batch."""
    training = pf_corrected(**TINY)
    loss: Any = training.trainer.loss_module  # type: ignore[attr-defined]
    for batch in training.collector:  # type: ignore[attr-defined]
        variant = int(batch["train", "variant"][0, 0])
        found = list(run_again(loss.filters[variant], loss.scenarios[variant], batch))
        expected = batch["uav", "action"][..., :3]
        position = torch.stack([one.position for one in found], 1).detach()
        torch.testing.assert_close(position.float(), expected.float(), rtol=0, atol=1e-5)


def test_batches_longer_than_an_episode_are_refused() -> None:
    with pytest.raises(ValueError, match="steps=12 is not allowed"):
        pf_corrected(**{**TINY, "steps": 12})
