"""stable-baselines3's PPO: one policy corrects every UAV's EKF; evaluated, saved, loaded.

``CoLocVecEnv`` is a native ``VecEnv``: every UAV of every world an environment of its own. The team
believes its ranges to be four times as precise as they are: an error that a policy can correct.

    pip install -e .
    python -m training.examples.sb3_ppo
"""

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from agents.wrappers.correction import with_base
from coloc_env import CoLocVecEnv

SCENARIO: dict[str, Any] = {
    "uwb_std": 0.2,
    "believed_uwb_std": 0.05,
    "nlos": 0.3,
    "motion": "random",
}


def worlds(number: int, horizon: int, seed: int) -> CoLocVecEnv:
    """The EKF localizes; the action is what the policy adds to its estimate."""
    return with_base(CoLocVecEnv("indoor-v0", number, seed, horizon=horizon, **SCENARIO), "ekf")


def mean_error(model: PPO | None, env: VecNormalize, seed: int) -> float:
    """Mean error (m) over an episode of each world; without a model, of the base alone."""
    env.seed(seed)
    observations: Any = env.reset()
    over, errors = False, []
    while not over:
        if model is None:
            actions = np.zeros((env.num_envs, *env.action_space.shape), np.float32)
        else:
            actions, _ = model.predict(observations, deterministic=True)
        observations, rewards, dones, _ = env.step(actions)
        errors.append(-rewards.mean())
        over = bool(dones[0])  # worlds start and end together
    return float(np.mean(errors))


def main(
    steps: int = 600_000, number: int = 128, horizon: int = 200, seed: int = 0
) -> dict[str, float]:
    torch.set_num_threads(1)
    train = VecNormalize(worlds(number, horizon, 0), gamma=0.0)
    score = VecNormalize(VecMonitor(worlds(40, horizon, 0)), training=False, norm_reward=False)
    model = PPO(
        "MlpPolicy",
        train,
        n_steps=25,
        batch_size=number * 6 * 25 // 8,
        n_epochs=4,
        learning_rate=1e-3,
        gamma=0.0,  # corrections are not fed back: a bandit's
        policy_kwargs={"log_std_init": float(np.log(0.3))},
        seed=seed,
        device="cpu",
    )
    train.seed(1_000_000 * (seed + 1))  # after PPO, which seeds the worlds with its own seed
    out = Path(tempfile.mkdtemp(prefix="coloc-sb3-"))
    every = max(1, steps // train.num_envs // 3)
    callback = EvalCallback(
        score, n_eval_episodes=score.num_envs, eval_freq=every, log_path=str(out), verbose=0
    )
    before = mean_error(None, score, 0)
    start = time.perf_counter()
    model.learn(steps, callback=callback)
    speed = model.num_timesteps / (time.perf_counter() - start)

    model.save(out / "policy")
    train.save(str(out / "normal.pkl"))  # needed with the policy
    loaded = PPO.load(out / "policy", device="cpu")
    fresh = VecNormalize.load(str(out / "normal.pkl"), worlds(40, horizon, 0))
    fresh.training = fresh.norm_reward = False
    after = mean_error(loaded, fresh, 0)
    curve = -np.load(out / "evaluations.npz")["results"].mean(1) / horizon
    print("on the way:", ", ".join(f"{error:.3f} m" for error in curve))
    print(f"mean error {before:.3f} m of the EKF, {after:.3f} m corrected ({out})")
    print(f"{speed:,.0f} agent-steps/s")
    return {"before": before, "after": after, "speed": speed}


if __name__ == "__main__":
    main()
