"""SuperSuit's route from PettingZoo to stable-baselines3; ``sb3_ppo`` is the better one.

Copies of one world, one after the other; flat observations by ``coloc_env.envs.wrappers.Flatten``.
What it loses: ``TimeLimit.truncated`` is never set, so SB3 takes the horizon for a failure and does
not bootstrap there (harmless only with gamma = 0). The last step's infos (``episode_rmse``) are
overwritten by the next episode's. ``seed`` and ``get_attr`` raise AttributeError, so no
``PPO(seed=...)``. ``reset(seed)`` gives copy i the worlds seed + i, seed + i + 1, ..., which its
neighbours have, too (hence the loop below). It steps at a tenth of ``CoLocVecEnv``'s speed.

    pip install -e . supersuit
    python -m training.examples.supersuit_sb3
"""

import time
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from coloc_env import parallel_env
from coloc_env.envs.wrappers import Flatten

try:
    import supersuit
except ImportError:
    raise SystemExit("SuperSuit is not installed: pip install supersuit") from None


def worlds(copies: int, horizon: int, seed: int) -> VecEnv:
    """``copies`` worlds of six UAVs as 6 · ``copies`` environments of stable-baselines3."""
    env = parallel_env("indoor-v0", motion="random", horizon=horizon, action="displacement")
    rows = supersuit.pettingzoo_env_to_vec_env_v1(Flatten(env))
    many: Any = supersuit.concat_vec_envs_v1(rows, copies, base_class="stable_baselines3")
    for i, copy in enumerate(many.venv.vec_envs):
        copy.reset(seed=seed + 10_000 * i)  # the first of its own worlds
    return many


def mean_error(model: PPO, normal: VecNormalize, horizon: int) -> float:
    """Mean error (m) over an episode of each of ten held-out worlds."""
    env = worlds(10, horizon, 0)
    observations: Any = env.reset()
    errors = []
    for _ in range(horizon):
        actions, _ = model.predict(normal.normalize_obs(observations), deterministic=True)
        observations, rewards, _, _ = env.step(actions)
        errors.append(-rewards.mean())
    return float(np.mean(errors))


def main(
    steps: int = 120_000, copies: int = 8, horizon: int = 100, seed: int = 0
) -> dict[str, float]:
    torch.set_num_threads(1)
    set_random_seed(seed)
    train = VecNormalize(worlds(copies, horizon, 1_000_000 * (seed + 1)), gamma=0.0)
    model = PPO(
        "MlpPolicy",
        train,
        n_steps=50,
        batch_size=300,
        n_epochs=4,
        learning_rate=1e-3,
        gamma=0.0,
        policy_kwargs={"log_std_init": -1.0},
        device="cpu",
    )
    before = mean_error(model, train, horizon)
    start = time.perf_counter()
    model.learn(steps)
    speed = model.num_timesteps / (time.perf_counter() - start)
    after = mean_error(model, train, horizon)
    print(f"mean error {before:.2f} m before, {after:.2f} m after {model.num_timesteps} steps")
    print(f"{speed:,.0f} agent-steps/s")
    return {"before": before, "after": after, "speed": speed}


if __name__ == "__main__":
    main()
