"""A mixed team: in one world every UAV localizes by a method of its own; RMSE per UAV.

Methods are agents with their options, as ``coloc evaluate --agents`` takes them (``coloc agents``
lists them); only those that act for a whole team at once (``ekf_joint``) are refused. UAVs receive
each other's estimates, so one that is wrong and overconfident harms the others.

    pip install -e .
    python -m training.examples.mixed_team
"""

import time
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from agents.policies.team import Team
from coloc_env import Scenario, make_scenario, parallel_env

METHODS = ("ekf", "ekf:robust=huber", "pf500", "pfnn", "ekf_trust")


def evaluate(
    scenario: Scenario, methods: Mapping[str, str], seeds: Sequence[int]
) -> dict[str, float]:
    """RMSE (m) of each UAV over the worlds of these seeds."""
    env = parallel_env(scenario)
    team = Team(scenario, methods)
    squares = dict.fromkeys(env.possible_agents, 0.0)
    for seed in seeds:
        observations, infos = env.reset(seed=seed)
        team.reset()
        while env.agents:
            observations, _, _, _, infos = env.step(team(observations))
        for agent, info in infos.items():
            squares[agent] += info["episode_rmse"] ** 2 / len(seeds)
    return {agent: float(np.sqrt(square)) for agent, square in squares.items()}


def main(
    learned: str = "mappo",
    episodes: int = 5,
    horizon: int = 200,
    nlos: float = 0.3,
    seed: int = 0,
) -> dict[str, float]:
    torch.set_num_threads(1)
    methods = {f"uav_{i}": method for i, method in enumerate((learned, *METHODS))}
    scenario = make_scenario("indoor-v0", motion="random", nlos=nlos, horizon=horizon)
    seeds = range(seed, seed + episodes)
    start = time.perf_counter()
    mixed = evaluate(scenario, methods, seeds)
    seconds = time.perf_counter() - start
    alike = evaluate(scenario, dict.fromkeys(methods, "ekf"), seeds)
    for agent, method in methods.items():
        print(f"{agent}  {method:20} {mixed[agent]:.3f} m (all of them ekf: {alike[agent]:.3f} m)")
    print(f"{len(methods) * episodes * horizon / seconds:,.0f} agent-steps/s")
    return mixed


if __name__ == "__main__":
    main()
