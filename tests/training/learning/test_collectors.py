"""Several collectors as one: in which order, and side by side in what shape."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict

from agents import make
from agents.policies.adapters import LocalizerPolicy
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.scenarios import make_scenario
from training.learning.collectors import Concatenated, RoundRobin, episode_collector


class Finite:
    """As much of a collector as several together need."""

    def __init__(self, batches: list[TensorDict]) -> None:
        self.batches, self.shut = batches, False

    def __iter__(self) -> Any:
        return iter(self.batches)

    def shutdown(self) -> None:
        self.shut = True


def batches(i: int, count: int, rows: int = 2) -> list[TensorDict]:
    """Of collector i: each row holds whose it is, which batch and which row."""
    which = [torch.tensor([[i, k, row] for row in range(rows)]) for k in range(count)]
    return [TensorDict({"in": {"which": one}}, [rows]) for one in which]


def test_round_robin_yields_every_batch() -> None:
    """Round after round, those that have finished left out."""
    collectors: list[Any] = [Finite(batches(i, 3 + i, rows=1)) for i in range(3)]
    several = RoundRobin(collectors)
    found = [batch["in", "which"][0, :2].tolist() for batch in several]
    assert found == [[i, k] for k in range(5) for i in range(3) if k < 3 + i]
    several.shutdown()
    assert all(one.shut for one in collectors)


def test_concatenated_collectors_yield_the_rows_of_all() -> None:
    collectors: list[Any] = [Finite(batches(i, 3, rows=1 + i)) for i in range(3)]
    several = Concatenated(collectors)
    found = list(several)
    assert len(found) == 3
    for k, batch in enumerate(found):
        assert batch.shape == (6,)
        expected = [[i, k, row] for i in range(3) for row in range(1 + i)]
        assert batch["in", "which"].tolist() == expected
    several.shutdown()
    assert all(one.shut for one in collectors)


def test_collectors_of_unlike_length_are_refused() -> None:
    """A batch would be lost without a word."""
    collectors: list[Any] = [Finite(batches(i, 2 + i)) for i in range(2)]
    with pytest.raises(ValueError, match="longer"):
        list(Concatenated(collectors))


def test_real_collectors_are_concatenated() -> None:
    parts, alone = [], []
    for case, worlds in ((1, 2), (3, 1)):
        scenario = make_scenario("wsn-v0", case=case, horizon=6)
        for kept in (parts, alone):
            policy = LocalizerPolicy(make("ekf", scenario), scenario)
            kept.append(
                episode_collector(
                    CoLocEnv(scenario, worlds, seed=case), policy, 3, compact_obs=True
                )
            )
    together = list(Concatenated(parts))
    assert [batch.shape for batch in together] == [(3, 3), (3, 3)]
    apart = zip(*alone, strict=True)
    for batch, pieces in zip(together, apart, strict=True):
        for key in (("uav", "action"), ("uav", "observation", "anchor_ranges"), "state"):
            assert torch.equal(batch[key], torch.cat([part[key] for part in pieces]))
