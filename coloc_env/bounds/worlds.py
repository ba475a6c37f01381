"""The very worlds that localizers are scored on, step by step, for bounds to be computed in."""

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from coloc_env.motion import Kinematics
from coloc_env.observation import Observation, action_width
from coloc_env.scenario import Scenario
from coloc_env.world import World

_NUMBERS = 2**24  # of joint matrices held at once: 128 MiB


def seeds_of(
    what: str, scenario: Scenario, runs: int, seed: int, steps: int, joint: int
) -> Sequence[Int64[Tensor, "B"]]:
    """Seeds ``seed`` … ``seed + runs − 1``, in blocks whose ``joint`` × ``joint`` matrices fit.

    Raises ValueError, in the name of ``what``, for fewer than one run or impossible ``steps``.
    """
    if runs < 1 or not 1 <= steps <= scenario.horizon:
        raise ValueError(
            f"{what}: runs={runs}, steps={steps} is not allowed: at least one run, and "
            f"steps from 1 to {scenario.horizon}"
        )
    return torch.arange(seed, seed + runs).split(max(1, _NUMBERS // joint**2))


def worlds(
    scenario: Scenario, seeds: Int64[Tensor, "B"], steps: int
) -> Iterator[tuple[Kinematics, Observation, Bool[Tensor, "B N"]]]:
    """Truth, observation and who is scored, step by step."""
    world = World(scenario, len(seeds))
    seen = world.reset(seeds)
    idle = torch.zeros(
        len(seeds), scenario.arena.n_uavs, action_width(scenario), dtype=torch.float32
    )
    for _ in range(steps):
        yield world.truth, seen, world.score(idle)[1]
        world.advance(idle)
        seen = world.observation()
