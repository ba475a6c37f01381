"""stable-baselines3's SAC: one policy for every UAV that localizes from nothing, by displacements.

The action moves a UAV's last estimate by up to 1 m an axis; the policy sees the fixes by landmarks
relative to it. Off-policy: every step of all UAVs goes into one replay buffer.

    pip install -e .
    python -m training.examples.sb3_sac
"""

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from coloc_env import CoLocVecEnv


def worlds(number: int, horizon: int) -> CoLocVecEnv:
    return CoLocVecEnv("indoor-v0", number, action="displacement", motion="random", horizon=horizon)


def mean_error(model: SAC, env: VecNormalize, seed: int) -> float:
    """Mean error (m) over an episode of each world."""
    env.seed(seed)
    observations: Any = env.reset()
    over, errors = False, []
    while not over:
        actions, _ = model.predict(observations, deterministic=True)
        observations, rewards, dones, _ = env.step(actions)
        errors.append(-rewards.mean())
        over = bool(dones[0])  # worlds start and end together
    return float(np.mean(errors))


def main(
    steps: int = 60_000, number: int = 16, horizon: int = 200, seed: int = 0
) -> dict[str, float]:
    torch.set_num_threads(1)
    train = VecNormalize(worlds(number, horizon), norm_reward=False)
    score = VecNormalize(VecMonitor(worlds(20, horizon)), training=False, norm_reward=False)
    model = SAC(
        "MlpPolicy",
        train,
        learning_starts=20 * train.num_envs,
        train_freq=1,  # one step of every UAV
        gradient_steps=4,
        batch_size=256,
        learning_rate=1e-3,
        gamma=0.0,  # what an action is worth shows at once, in the error of this very step
        ent_coef=0.01,
        policy_kwargs={"net_arch": [64, 64]},
        seed=seed,
        device="cpu",
    )
    train.seed(1_000_000 * (seed + 1))  # after SAC, which seeds the worlds with its own seed
    out = Path(tempfile.mkdtemp(prefix="coloc-sb3-"))
    every = max(1, steps // train.num_envs // 3)
    callback = EvalCallback(
        score, n_eval_episodes=score.num_envs, eval_freq=every, log_path=str(out), verbose=0
    )
    before = mean_error(model, score, 0)
    start = time.perf_counter()
    model.learn(steps, callback=callback)
    speed = model.num_timesteps / (time.perf_counter() - start)

    model.save(out / "policy")
    train.save(str(out / "normal.pkl"))  # needed with the policy
    loaded = SAC.load(out / "policy", device="cpu")
    fresh = VecNormalize.load(str(out / "normal.pkl"), worlds(20, horizon))
    fresh.training = fresh.norm_reward = False
    after = mean_error(loaded, fresh, 0)
    curve = -np.load(out / "evaluations.npz")["results"].mean(1) / horizon
    print("on the way:", ", ".join(f"{error:.3f} m" for error in curve))
    print(f"mean error {before:.2f} m before, {after:.2f} m after ({out})")
    print(f"{speed:,.0f} agent-steps/s")
    return {"before": before, "after": after, "speed": speed}


if __name__ == "__main__":
    main()
