"""PettingZoo: the parallel loop, the agent-environment cycle, and ``pettingzoo.make``.

Actions are displacements (m, in [-1, 1]) of each UAV's last estimate. Random ones let the estimates
wander off; moving by ``fix_mean``, the mean of the fixes by landmarks, is a first localizer. The
same worlds, agent by agent, give the same errors.

    pip install -e .
    python -m training.examples.pettingzoo_loop
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pettingzoo
import torch
from pettingzoo import AECEnv, ParallelEnv

import coloc_env  # registers the scenarios with PettingZoo

Policy = Callable[[str, dict[str, np.ndarray]], np.ndarray]


def parallel(env: ParallelEnv, policy: Policy, episodes: int, seed: int) -> float:
    """Mean error (m): all UAVs act at once."""
    errors = []
    for episode in range(episodes):
        observations, infos = env.reset(seed=seed + episode)
        while env.agents:  # empty once every UAV is truncated (the horizon) or terminated (failed)
            actions = {agent: policy(agent, observations[agent]) for agent in env.agents}
            observations, _rewards, _terminated, _truncated, infos = env.step(actions)
        errors += [info["episode_mean"] for info in infos.values()]
    return float(np.mean(errors))


def cycle(env: AECEnv, policy: Policy, episodes: int, seed: int) -> float:
    """Mean error (m): one UAV after the other; the world moves on after the last."""
    errors = []
    for episode in range(episodes):
        env.reset(seed=seed + episode)
        for agent in env.agent_iter():
            observation, _reward, terminated, truncated, info = env.last()
            over = terminated or truncated
            if over:
                errors.append(info["episode_mean"])
            env.step(None if over else policy(agent, observation))  # None: its last turn
    return float(np.mean(errors))


def main(episodes: int = 5, horizon: int = 200, seed: int = 0) -> dict[str, float]:
    torch.set_num_threads(1)
    options: dict[str, Any] = {"motion": "random", "horizon": horizon, "action": "displacement"}
    env = pettingzoo.make("parallel", "coloc/indoor-v0", **options)
    env.action_space("uav_0").seed(seed)  # one space, shared by all agents

    def random(agent: str, observation: dict[str, np.ndarray]) -> np.ndarray:
        return env.action_space(agent).sample()

    def by_landmarks(agent: str, observation: dict[str, np.ndarray]) -> np.ndarray:
        return observation["fix_mean"].clip(-1, 1)

    start = time.perf_counter()
    found = {
        "random": parallel(env, random, episodes, seed),
        "landmarks": parallel(env, by_landmarks, episodes, seed),
    }
    seconds = time.perf_counter() - start
    found["landmarks, AEC"] = cycle(coloc_env.env(**options), by_landmarks, episodes, seed)
    for name, error in found.items():
        print(f"{name:15} mean error {error:6.2f} m")
    steps = 2 * episodes * horizon * len(env.possible_agents)
    print(f"{steps / seconds:,.0f} agent-steps/s")
    return found


if __name__ == "__main__":
    main()
