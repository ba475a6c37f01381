"""Time and memory of one step as one size of a problem grows."""

from __future__ import annotations

import statistics
import time
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
LONGEST = 1.5  # s a step, beyond which larger sizes are left out


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
def measure(sweep: Sweep, device: torch.device, seconds: float) -> dict[str, list[float]]:
    """By size: ``ms`` of a step of worlds and agent, of which ``agents_ms`` is the agent's; bytes
    that torch allocates at the height of a step, sensing included, and of the ``belief``.

    Times are this process's own, whatever else the machine does (on a card: the card's). What
    worlds sense ahead is shared by the steps that it serves; the agent's is the median of about
    ``seconds`` of steps.
    """
    found: dict[str, list[float]] = {
        key: [] for key in ("size", "ms", "agents_ms", "bytes", "belief")
    }
    for size in sweep.sizes:
        try:
            one = _Case(sweep, size, device)
            world = one.world_seconds()
            longest = one.step() if sweep.agent else 0.0  # what is made once is made here
            steps = [longest]
            while sweep.agent and (len(steps) <= SHORT or sum(steps[1:]) < seconds):
                steps.append(one.step())
            peak = one.peak()
        except (MemoryError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and "memory" not in str(error):
                raise
            break
        agent = statistics.median(steps[1:] or steps)
        found["size"].append(size)
        found["ms"].append(1e3 * (world + agent))
        found["agents_ms"].append(1e3 * agent)
        found["bytes"].append(peak)
        found["belief"].append(one.belief.bytes() if sweep.agent else 0)
        if world + longest > LONGEST:
            break
    return found


class _Case:
    """A team in its worlds, step by step; the last step again where an episode ends."""

    def __init__(self, sweep: Sweep, size: int, device: torch.device) -> None:
        agent, worlds, overrides = sweep.case(size)
        scenario = make_scenario(sweep.scenario, **overrides)
        self.horizon, self.device = scenario.horizon, device
        self.world = World(scenario, worlds, device)
        self.localizer = None if agent is None else make(agent, scenario).to(device)
        self.action = torch.zeros(worlds, scenario.arena.n_uavs, 3 * scenario.arena.dim).to(device)
        self.world.reset(0)
        self.belief: Any = None

    def world_seconds(self) -> float:
        """Of a step, on average over those that are sensed at once; an episode that fits into one
        window is sensed as it starts."""
        steps = min(self.world.window, self.horizon - 1)
        start = self._now()
        if self.world.window >= self.horizon:
            self.world.reset(0)
        for _ in range(steps):
            self.world.advance(self.action)
            self.world.observation()
        spent = self._now() - start
        self.world.reset(0)
        return spent / steps

    def step(self) -> float:
        """Seconds of the agent's part of a step."""
        assert self.localizer is not None
        observation = self.world.observation()
        if self.belief is None:
            self.belief = self.localizer.reset(observation)
        start = self._now()
        self.belief, estimate = self.localizer.step(self.belief, observation)
        spent = self._now() - start
        self.world.advance(estimate.action())
        return spent

    def peak(self) -> int:
        """Bytes allocated at the height of a step, as torch counts them: of the agent's work, or of
        the sensing of a window, whichever is more."""
        agent = self._allocated(self.step) if self.localizer is not None else 0
        return max(agent, self._allocated(lambda: self.world.reset(0)))

    def _allocated(self, work: Callable[[], Any]) -> int:
        if self.device.type != "cuda":
            return peak_bytes(work)
        torch.cuda.reset_peak_memory_stats(self.device)
        work()
        return torch.cuda.max_memory_allocated(self.device)

    def _now(self) -> float:
        return clock(self.device) if self.device.type == "cuda" else time.process_time()
