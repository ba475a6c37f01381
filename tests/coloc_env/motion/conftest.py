"""Flying a motion in tests."""

from collections.abc import Callable

import pytest
import torch

from coloc_env import noise
from coloc_env.motion import Arena, Kinematics, Motion

Fly = Callable[..., Kinematics]


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture
def arena() -> Callable[..., Arena]:
    """An arena from its sides (m), low corner at ``low``."""

    def build(*sides: float, n: int = 6, dt: float = 0.1, low: float = 0.0) -> Arena:
        high = tuple(low + side for side in sides)
        return Arena(len(sides), n, dt, (low,) * len(sides), high)

    return build


@pytest.fixture
def fly() -> Fly:
    """Kinematics of ``steps`` steps from ``first`` on, in windows of ``window`` steps."""

    def run(
        motion: Motion,
        arena: Arena,
        seeds: list[int],
        steps: int,
        window: int | None = None,
        first: list[int] | None = None,
    ) -> Kinematics:
        carry = motion.start(noise.row_keys(torch.tensor(seeds)), arena)
        assert all(len(value) == len(seeds) for value in carry.values())
        start = torch.tensor(first or [0] * len(seeds)).unsqueeze(-1)
        parts = []
        for k in range(0, steps, window or steps):
            index = torch.arange(k, min(k + (window or steps), steps))
            truth, carry = motion.advance(carry, start + index, arena)
            parts.append(truth)
        return Kinematics(
            torch.cat([part.position for part in parts], 1),
            torch.cat([part.velocity for part in parts], 1),
            torch.cat([part.attitude for part in parts], 1),
        )

    return run
