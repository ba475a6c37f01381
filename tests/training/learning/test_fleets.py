"""Several collectors as one: in which order, and side by side in what shape."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict

from agents import make
from agents.policies.adapters import LocalizerPolicy
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.scenarios import make_scenario
from training.learning.collectors import fly
from training.learning.fleets import SideBySide, TakingTurns


class Landed:
    """As much of a collector as a fleet asks for."""

    def __init__(self, batches: list[TensorDict]) -> None:
        self.batches, self.shut = batches, False

    def __iter__(self) -> Any:
        return iter(self.batches)

    def shutdown(self) -> None:
        self.shut = True


def batches(i: int, count: int, rows: int = 2) -> list[TensorDict]:
    """Of collector i: each row says whose it is, which batch and which row."""
    said = [torch.tensor([[i, k, row] for row in range(rows)]) for k in range(count)]
    return [TensorDict({"in": {"said": one}}, [rows]) for one in said]


def test_a_fleet_that_takes_turns_yields_every_batch() -> None:
    """Round after round, those that have landed left out."""
    collectors: list[Any] = [Landed(batches(i, 3 + i, rows=1)) for i in range(3)]
    fleet = TakingTurns(collectors)
    found = [batch["in", "said"][0, :2].tolist() for batch in fleet]
    assert found == [[i, k] for k in range(5) for i in range(3) if k < 3 + i]
    fleet.shutdown()
    assert all(one.shut for one in collectors)


def test_a_fleet_side_by_side_yields_the_rows_of_all() -> None:
    collectors: list[Any] = [Landed(batches(i, 3, rows=1 + i)) for i in range(3)]
    fleet = SideBySide(collectors)
    found = list(fleet)
    assert len(found) == 3
    for k, batch in enumerate(found):
        assert batch.shape == (6,)
        expected = [[i, k, row] for i in range(3) for row in range(1 + i)]
        assert batch["in", "said"].tolist() == expected
    fleet.shutdown()
    assert all(one.shut for one in collectors)


def test_nobody_lands_earlier_than_who_flies_beside() -> None:
    """A batch would be lost without a word."""
    collectors: list[Any] = [Landed(batches(i, 2 + i)) for i in range(2)]
    with pytest.raises(ValueError, match="longer"):
        list(SideBySide(collectors))


def test_real_flights_stand_side_by_side() -> None:
    flown, alone = [], []
    for case, worlds in ((1, 2), (3, 1)):
        scenario = make_scenario("wsn-v0", case=case, horizon=6)
        for kept in (flown, alone):
            policy = LocalizerPolicy(make("ekf", scenario), scenario)
            kept.append(fly(CoLocEnv(scenario, worlds, seed=case), policy, 3, compact_obs=True))
    together = list(SideBySide(flown))
    assert [batch.shape for batch in together] == [(3, 3), (3, 3)]
    apart = zip(*alone, strict=True)
    for batch, parts in zip(together, apart, strict=True):
        for key in (("uav", "action"), ("uav", "observation", "anchor_ranges"), "state"):
            assert torch.equal(batch[key], torch.cat([part[key] for part in parts]))
