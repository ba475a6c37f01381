"""What others' environments of the same kind cost, where they are installed: mpe2 and VMAS."""

import importlib.util
from collections.abc import Callable, Iterator

import numpy as np
import torch

from training.bench.cases import ENDLESS, Case, Timed

N_AGENTS = 6


def peers() -> Iterator[Case]:
    """``simple_spread`` with six agents in mpe2 (one world) and VMAS (1, 32, 1024 worlds)."""
    if importlib.util.find_spec("mpe2"):
        yield Case("mpe2 simple_spread", "B=1", N_AGENTS, 128, _mpe2)
    if importlib.util.find_spec("vmas"):
        for size, steps in ((1, 32), (32, 32), (1024, 8)):
            yield Case("VMAS simple_spread", f"B={size}", N_AGENTS * size, steps, vmas_worlds(size))


def _mpe2() -> Timed:
    from mpe2 import simple_spread_v3

    env = simple_spread_v3.parallel_env(N=N_AGENTS, max_cycles=ENDLESS, continuous_actions=True)
    env.reset(seed=0)
    actions = {agent: np.full(5, 0.5, np.float32) for agent in env.agents}

    def run(steps: int) -> None:
        for _ in range(steps):
            env.step(actions)

    return Timed(run)


def vmas_worlds(
    size: int, task: str = "simple_spread", agents: int = N_AGENTS
) -> Callable[[], Timed]:
    """Steps of so many worlds of one of VMAS's tasks, by agents that do nothing."""

    def setup() -> Timed:
        import vmas

        env = vmas.make_env(
            task,
            num_envs=size,
            device="cpu",
            continuous_actions=True,
            n_agents=agents,
            seed=0,
        )
        env.reset()
        actions = [torch.zeros(size, 2) for _ in range(agents)]

        def run(steps: int) -> None:
            for _ in range(steps):
                env.step(actions)

        return Timed(run)

    return setup
