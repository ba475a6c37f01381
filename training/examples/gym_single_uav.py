"""One learner among localizers: a single UAV as a Gymnasium environment, for stable-baselines3.

The other UAVs are localized by a filter (``others``). The learner starts from nothing: it moves its
last estimate (``base="none"``; with a localizer's name it corrects that one's estimates instead).

    pip install -e .
    python -m training.examples.gym_single_uav
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from agents.policies.team import SingleUavEnv

Policy = Callable[[np.ndarray], np.ndarray]


def mean_error(env: gym.Env, policy: Policy, episodes: int, seed: int) -> float:
    """Mean error (m) of the one UAV."""
    errors = []
    for episode in range(episodes):
        observation, info = env.reset(seed=seed + episode)
        over = False
        while not over:
            observation, _reward, terminated, truncated, info = env.step(policy(observation))
            over = terminated or truncated
        errors.append(info["episode_mean"])
    return float(np.mean(errors))


def main(
    steps: int = 10_000, envs: int = 4, horizon: int = 100, episodes: int = 10, seed: int = 0
) -> dict[str, float]:
    torch.set_num_threads(1)
    options: dict[str, Any] = {"others": "ekf", "base": "none", "motion": "random"}
    options["horizon"] = horizon

    def make_env(i: int) -> SingleUavEnv:
        env = SingleUavEnv(**options)
        env.reset(seed=1_000_000 * (seed + 1) + 10_000 * i)  # the first of this one's own worlds
        return env

    # Not PPO(seed=...): that would restart the copies at worlds seed, seed + 1, ...; as each goes
    # on to the next world by itself, they would meet the same worlds, and those of the score.
    set_random_seed(seed)
    train = VecNormalize(DummyVecEnv([partial(make_env, i) for i in range(envs)]), gamma=0.0)
    model = PPO(
        "MlpPolicy",
        train,
        n_steps=horizon,
        batch_size=100,
        learning_rate=1e-3,
        gamma=0.0,  # what an action is worth shows at once, in the error of this very step
        policy_kwargs={"log_std_init": -1.0},
        device="cpu",
    )

    def policy(observation: np.ndarray) -> np.ndarray:
        return model.predict(train.normalize_obs(observation[None]), deterministic=True)[0][0]

    score = SingleUavEnv(**options)
    before = mean_error(score, policy, episodes, seed)
    start = time.perf_counter()
    model.learn(steps)
    speed = model.num_timesteps / (time.perf_counter() - start)
    after = mean_error(score, policy, episodes, seed)
    print(f"mean error {before:.2f} m before, {after:.2f} m after {model.num_timesteps} steps")
    print(f"{speed:,.0f} steps/s of the one UAV")
    return {"before": before, "after": after, "speed": speed}


if __name__ == "__main__":
    main()
