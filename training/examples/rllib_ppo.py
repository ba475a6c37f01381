"""RLlib's PPO (new API stack) on the PettingZoo face: one policy for all UAVs, by displacements.

Traps: ``vf_clip_param`` is 10 by default, and there is no gradient where the critic's squared error
is larger; ``train_batch_size_per_learner`` counts the world's steps, ``minibatch_size`` an agent's,
and it must not be larger; without ``Flatten`` the Dict observations need ``FlattenObservations`` as
a connector. (Should some UAVs fail and the rest be truncated, RLlib's own wrapper does not report
that the episode is over; ``Flatten`` refuses such scenarios.)

    pip install -e . "ray[rllib]==2.60.0"
    python -m training.examples.rllib_ppo
"""

import os
import time
from typing import Any

os.environ.setdefault("RAY_AUTH_MODE", "disabled")  # a Ray of this process alone: no tokens

import numpy as np
import ray
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

from coloc_env import parallel_env
from coloc_env.envs.wrappers import Flatten


def world(settings: dict[str, Any]) -> Flatten:
    return Flatten(parallel_env("indoor-v0", action="displacement", motion="random", **settings))


@torch.no_grad()
def mean_error(module: Any, settings: dict[str, Any], episodes: int) -> float:
    """Mean error (m) of the best actions in held-out worlds."""
    env, errors = world(settings), []
    for seed in range(episodes):
        observations, infos = env.reset(seed=seed)
        while env.agents:
            seen = torch.from_numpy(np.stack([observations[agent] for agent in env.agents]))
            found = module.forward_inference({"obs": seen})["action_dist_inputs"]
            actions = found[:, : found.shape[1] // 2].clamp(-1, 1).numpy()  # means, then log-stds
            observations, *_, infos = env.step(dict(zip(env.agents, actions, strict=True)))
        errors += [info["episode_mean"] for info in infos.values()]
    return float(np.mean(errors))


def main(
    iterations: int = 15, steps: int = 1000, horizon: int = 100, episodes: int = 5, seed: int = 0
) -> dict[str, float]:
    settings = {"horizon": horizon}
    register_env("coloc", lambda settings: ParallelPettingZooEnv(world(settings)))
    network = DefaultModelConfig(fcnet_hiddens=[64, 64])
    specs = {"uav": RLModuleSpec(model_config=network)}
    config = (
        PPOConfig()
        .environment("coloc", env_config=settings)
        .env_runners(num_env_runners=0)  # sample in this process
        .multi_agent(policies={"uav"}, policy_mapping_fn=lambda agent, episode, **_: "uav")
        .rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs=specs))
        .training(
            lr=1e-3,
            gamma=0.0,  # what an action is worth shows at once, in the error of this very step
            train_batch_size_per_learner=steps,
            minibatch_size=min(500, steps),
            num_epochs=8,
            vf_clip_param=float("inf"),
        )
        .debugging(seed=1_000_000 * (seed + 1), log_level="ERROR")  # the worlds' seeds, too
    )
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
    algorithm = config.build_algo()
    torch.set_num_threads(1)  # Ray sets another number
    before = mean_error(algorithm.get_module("uav"), settings, episodes)
    start, agent_steps = time.perf_counter(), 0
    for _ in range(iterations):
        sampled = algorithm.train()["env_runners"]
        agent_steps += int(sum(sampled["num_agent_steps_sampled"].values()))
    speed = agent_steps / (time.perf_counter() - start)
    after = mean_error(algorithm.get_module("uav"), settings, episodes)
    algorithm.stop()
    ray.shutdown()
    print(f"mean error {before:.2f} m before, {after:.2f} m after {agent_steps} agent-steps")
    print(f"{speed:,.0f} agent-steps/s")
    return {"before": before, "after": after, "speed": speed}


if __name__ == "__main__":
    main()
