"""Time and memory of one step as one size of a problem grows."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from agents import make
from coloc_env.scenarios import make_scenario
from coloc_env.world import World
from training.devices import clock
from training.memory import peak_bytes

SHORT = 3  # steps that are timed, at least
LONGEST = 4.0  # s a step, beyond which larger sizes are left out


@dataclass(frozen=True)
class Sweep:
    """``agent`` (None: the world alone) in ``worlds`` worlds of a scenario, of which ``key``, one
    of its overrides, "worlds" or "particles", takes ``sizes``."""

    name: str
    key: str
    sizes: Sequence[int]
    agent: str | None = None
    scenario: str = "indoor-v0"
    worlds: int = 1
    overrides: tuple[tuple[str, Any], ...] = field(default=())

    def case(self, size: int) -> tuple[str | None, int, dict[str, Any]]:
        """Agent, worlds and overrides at a size."""
        overrides, worlds, agent = dict(self.overrides), self.worlds, self.agent
        if self.key == "worlds":
            worlds = size
        elif self.key == "particles":
            agent = f"{agent}:particles={size}"
        else:
            overrides[self.key] = size
        return agent, worlds, overrides


@torch.no_grad()
def measure(
    sweep: Sweep, device: torch.device, seconds: float, progress: Callable[[int], None]
) -> dict[str, list[float]]:
    """By size: ``ms`` of a step of world and agent, median over about ``seconds``; ``agents_ms``
    the agent's share; ``bytes``: what torch allocates at the height of a step, and ``belief``."""
    found: dict[str, list[float]] = {
        key: [] for key in ("size", "ms", "agents_ms", "bytes", "belief")
    }
    for done, size in enumerate(sweep.sizes, 1):
        one = _Case(sweep, size, device)
        try:
            one.step()  # what is made once
            longest = sum(one.step())
            steps: list[tuple[float, float]] = []
            while len(steps) < SHORT or sum(map(sum, steps)) < seconds:
                steps.append(one.step())
        except (MemoryError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and "memory" not in str(error):
                raise
            break
        found["size"].append(size)
        found["ms"].append(1e3 * statistics.median(map(sum, steps)))
        found["agents_ms"].append(1e3 * statistics.median(agent for _, agent in steps))
        found["bytes"].append(one.peak())
        found["belief"].append(one.belief.bytes() if sweep.agent else 0)
        progress(done)
        if longest > LONGEST:
            break
    return found


class _Case:
    """A team in its worlds, step by step; a new episode where one ends."""

    def __init__(self, sweep: Sweep, size: int, device: torch.device) -> None:
        agent, worlds, overrides = sweep.case(size)
        scenario = make_scenario(sweep.scenario, **overrides)
        self.horizon, self.device = scenario.horizon, device
        self.world = World(scenario, worlds, device)
        self.localizer = None if agent is None else make(agent, scenario).to(device)
        shape = worlds, scenario.arena.n_uavs, 3 * scenario.arena.dim
        self.action = torch.zeros(shape, device=device)
        self.k = self.horizon

    def step(self) -> tuple[float, float]:
        """Seconds of the world's part and of the agents'."""
        start = clock(self.device)
        fresh = self.k + 1 >= self.horizon
        if fresh:
            self.world.reset(0)
        else:
            self.world.advance(self.action)
        self.k = 0 if fresh else self.k + 1
        observation = self.world.observation()
        between = clock(self.device)
        if self.localizer is not None:
            if fresh:
                self.belief = self.localizer.reset(observation)
            self.belief, estimate = self.localizer.step(self.belief, observation)
            self.action = estimate.action()
        return between - start, clock(self.device) - between

    def peak(self) -> int:
        """Bytes allocated at the height of a step, as torch counts them."""
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
            self.step()
            return torch.cuda.max_memory_allocated(self.device)
        return peak_bytes(self.step)
