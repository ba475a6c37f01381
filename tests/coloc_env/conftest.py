"""What tests of whole scenarios share."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from coloc_env.scenario import Scenario
from coloc_env.world import World


def trajectory(
    scenario: Scenario, steps: int, seeds: list[int], window: int | None = None
) -> Tensor:
    """Positions and every leaf, side by side [K, B, N, F]; actions do not matter."""
    world, found = World(scenario, len(seeds), window=window), []
    seen, n = world.reset(seeds), scenario.arena.n_uavs
    for k in range(steps):
        found.append(torch.cat((world.truth.position, *seen.leaves.values()), -1))
        world.advance(torch.full((len(seeds), n, 3 * scenario.arena.dim), float(k)))
        seen = world.observation()
    return torch.stack(found)


@pytest.fixture
def rows_are_their_own_worlds() -> Callable[[Scenario, int], None]:
    """Asserts that a row of a batch is its own world whatever the window, to the last bit."""

    def check(scenario: Scenario, steps: int) -> None:
        seeds = [5, 0, 9, 2**40, 7]
        together = trajectory(scenario, steps, seeds)
        for row, window in ((0, 1), (3, 7), (4, 64)):
            alone = trajectory(scenario, steps, seeds[row : row + 1], window)
            assert torch.equal(alone, together[:, row : row + 1])

    return check
