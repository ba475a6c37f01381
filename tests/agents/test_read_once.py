"""What a localizer reads of an observation it reads once a step; that changes no bit."""

from collections import Counter
from typing import Any

import pytest
import torch

from agents import make
from agents.models.measurements import ranges, vectors
from coloc_env.observation import Observation
from coloc_env.scenarios import make_scenario
from training.evaluation.rollout import rollout

ROOM = {"n_uavs": 3, "nlos": 0.3, "false_matches": 0.2, "prior": "uniform"}
KINDS = {
    "ekf:robust=huber+gate+temporal": ("indoor-v0", ROOM),
    "ekf:fusion=pairwise": ("indoor-v0", ROOM),
    "nnhpff": ("wsn-v0", {}),
}


@pytest.mark.parametrize("agent", KINDS)
def test_reading_once_changes_no_bit(agent: str, monkeypatch: pytest.MonkeyPatch) -> None:
    name, overrides = KINDS[agent]
    scenario = make_scenario(name, **overrides)
    calls: Counter[str] = Counter()
    whole = ranges.usable

    def usable(*args: Any, **named: Any) -> Any:
        calls["now"] += 1
        return whole(*args, **named)

    for module in (ranges, vectors):
        monkeypatch.setattr(module, "usable", usable)

    def outcome() -> tuple[list[torch.Tensor], int]:
        calls.clear()
        steps = rollout(make(agent, scenario), scenario, torch.arange(2), 4)
        found = [part for s in steps for part in (s.action, s.estimate.covariance)]  # type: ignore[union-attr]
        return found, calls["now"]

    once, reads = outcome()
    monkeypatch.setattr(Observation, "kept", lambda observation: observation)
    every, more = outcome()
    assert all(torch.equal(a, b) for a, b in zip(once, every, strict=True))
    assert 0 < reads < more


def test_an_observation_of_ones_own_is_read_anew() -> None:
    """Only a step's own copy remembers: an edit in place is seen by the next step."""
    observation = Observation({"ranges": torch.zeros(1, 1, 1)})
    assert [observation.once("a", lambda i=i: i) for i in (1, 2)] == [1, 2]  # type: ignore[misc]
    kept = observation.kept()
    assert [kept.once("a", lambda i=i: i) for i in (1, 2)] == [1, 1]  # type: ignore[misc]
    assert kept.kept() is kept
    assert observation.kept().once("a", lambda: 3) == 3
