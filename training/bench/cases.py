"""What ``coloc bench`` times: worlds of several sizes, and both faces."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from coloc_env.envs.pettingzoo import parallel_env
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

ENDLESS = 10**9  # steps: no episode ends while it is timed
SIZES = (1, 32, 1024)
_STEPS = {1: 100, 32: 100, 1024: 10}  # of a rollout, or a collector's batch
TEAMS = (2, 6, 12, 24, 50, 100, 200)
LANDMARKS = (0, 5, 20, 80)


@dataclass(frozen=True)
class Timed:
    """``run(steps)``; every ``window`` steps cost alike (what is sensed ahead is paid at once)."""

    run: Callable[[int], None]
    window: int = 1


@dataclass(frozen=True)
class Case:
    """One row of the table: ``agents`` agent-steps a step, at least ``steps`` steps a round."""

    group: str
    name: str
    agents: int
    steps: int
    setup: Callable[[], Timed]

    @property
    def key(self) -> str:
        return f"{self.group} {self.name}"


def cases() -> Iterator[Case]:
    """Everything of ours but the localizers."""
    for size in SIZES:
        yield Case("World", f"B={size}", 6 * size, 8, world(size))
    for n in (6, 200):
        yield Case("PettingZoo", f"N={n}", n, 8, _pettingzoo(n))
    for name, face in (("step", _step), ("rollout", _rollout), ("Collector", _collect)):
        for size in SIZES:
            yield Case(f"TorchRL {name}", f"B={size}", 6 * size, _STEPS[size], face(size))
    for size in SIZES[:2]:
        yield Case("World N=200", f"B={size}", 200 * size, 1, world(size, n_uavs=200))
    for n in TEAMS:
        yield Case("team", f"N={n}", n, 64, world(1, n_uavs=n))
    for count in LANDMARKS:
        yield Case("landmarks", f"L={count}", 6 * 32, 16, world(32, landmarks=count))
    if torch.cuda.is_available():
        for size in (1024, 16384):
            yield Case("World on GPU", f"B={size}", 6 * size, 20, world(size, device="cuda"))


def world(size: int, device: str = "cpu", **overrides: Any) -> Callable[[], Timed]:
    """Steps and observations of a batch of worlds."""

    def setup() -> Timed:
        scenario = make_scenario("indoor-v0", horizon=ENDLESS, **overrides)
        batch = World(scenario, size, device)
        batch.reset(0)
        action = torch.zeros(size, scenario.arena.n_uavs, 9, device=device)

        def run(steps: int) -> None:
            for _ in range(steps):
                batch.step(action)
                batch.observation()
            if device == "cuda":
                torch.cuda.synchronize()

        return Timed(run, batch.window)

    return setup


def _pettingzoo(n_uavs: int) -> Callable[[], Timed]:
    def setup() -> Timed:
        env = parallel_env(n_uavs=n_uavs, horizon=ENDLESS)
        env.reset(seed=0)
        actions = {agent: np.zeros(9, np.float32) for agent in env.agents}

        def run(steps: int) -> None:
            for _ in range(steps):
                env.step(actions)

        return Timed(run, env.world.window)

    return setup


def _step(size: int) -> Callable[[], Timed]:
    def setup() -> Timed:
        env = CoLocEnv(num_envs=size, seed=0, horizon=ENDLESS)
        now = [env.reset()]
        action = torch.zeros(size, 6, 9)

        def run(steps: int) -> None:
            for _ in range(steps):
                now[0]["uav", "action"] = action
                now[0] = env.step(now[0])["next"]

        return Timed(run, env.world.window)

    return setup


def _rollout(size: int) -> Callable[[], Timed]:
    """Random actions, as ``rollout`` without a policy takes them."""

    def setup() -> Timed:
        env = CoLocEnv(num_envs=size, seed=0, horizon=ENDLESS)

        def run(steps: int) -> None:
            env.rollout(steps, break_when_any_done=False)

        return Timed(run)

    return setup


def _collect(size: int) -> Callable[[], Timed]:
    """A policy that costs nothing."""

    def setup() -> Timed:
        from tensordict.nn import TensorDictModule
        from torchrl.collectors import Collector

        action = torch.zeros(size, 6, 9)
        policy = TensorDictModule(
            lambda prior: action,
            in_keys=[("uav", "observation", "prior")],
            out_keys=[("uav", "action")],
        )
        steps = _STEPS[size]
        collector = Collector(
            CoLocEnv(num_envs=size, seed=0, horizon=ENDLESS),
            policy,
            frames_per_batch=size * steps,
            total_frames=-1,
            auto_register_policy_transforms=False,
        )
        batches = iter(collector)

        def run(wanted: int) -> None:
            for _ in range(wanted // steps):
                next(batches)

        return Timed(run, steps)

    return setup
