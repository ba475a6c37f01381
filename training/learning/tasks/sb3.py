"""stable-baselines3's PPO on tasks, every UAV an environment of its ``VecEnv``."""

from functools import partial
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from agents.policies.decisions import actor_for
from agents.policies.task_actor import TaskActor
from agents.tasks import make_task
from coloc_env.envs.sb3 import CoLocVecEnv
from coloc_env.options import Factor, PositiveCount, Share
from training.learning.collectors import Epochs, Seed, Width, Worlds, world_seed
from training.learning.run import Training
from training.learning.sb3_ppo import Sb3Trainer
from training.learning.tasks.scoring import ScoreWorlds, score


def exported(model: PPO, actor: TaskActor) -> None:
    """Write a PPO ``MlpPolicy`` of two tanh layers into ``actor``, in place: the same actions."""
    policy: Any = model.policy
    first, _, second, _ = policy.mlp_extractor.policy_net
    pairs = ((actor.first, first), (actor.second, second), (actor.head, policy.action_net))
    with torch.no_grad():
        for ours, theirs in pairs:
            ours.weight.copy_(theirs.weight)
            ours.bias.copy_(theirs.bias)
        if not actor.discrete:
            actor.log_std.copy_(policy.log_std)


class Return(BaseCallback):
    """Logs the mean return of a rollout's episodes, with PPO's figures of training on it."""

    def _on_rollout_start(self) -> None:
        self.total = 0.0
        self.logger.dump(self.num_timesteps)

    def _on_step(self) -> bool:
        env: Any = self.training_env
        self.total += float(env.get_original_reward().mean())
        return True

    def _on_rollout_end(self) -> None:
        self.logger.record("return", self.total)

    def _on_training_end(self) -> None:
        self.logger.dump(self.num_timesteps)


def task_sb3_ppo(
    *,
    task: str = "survey-v0",
    hidden: Width = 64,
    worlds: Worlds = 128,
    epochs: Epochs = 36,
    passes: PositiveCount = 8,
    minibatches: PositiveCount = 8,
    learning_rate: Factor = 1.5e-3,
    gamma: Share = 0.97,
    gae_lambda: Share = 0.95,
    clip: Factor = 0.2,
    entropy: Share = 0.003,
    seed: Seed = 0,
    score_worlds: ScoreWorlds = 256,
) -> Training:
    """A policy for all UAVs of a task by stable-baselines3's PPO, with shared parameters.

    ``VecNormalize`` normalizes rewards. stable-baselines3 knows no action masks: what is not
    allowed simply fails. Options as ``coloc train task-ippo`` has them.
    """
    made = make_task(task)
    actor = actor_for(task, made, seed, hidden=hidden, sampled=made.sampled, squash="clip")
    worlds_env = CoLocVecEnv(made.scenario, worlds, action=made)
    env = VecNormalize(worlds_env, norm_obs=False, gamma=gamma)
    rows = worlds_env.num_envs * made.scenario.horizon
    model = PPO(
        "MlpPolicy",
        env,
        learning_rate=learning_rate,
        n_steps=made.scenario.horizon,
        batch_size=-(-rows // minibatches),
        n_epochs=passes,
        gamma=gamma,
        gae_lambda=gae_lambda,
        clip_range=clip,
        ent_coef=entropy,
        seed=seed,
        device="cpu",
        policy_kwargs={
            "net_arch": [hidden, hidden],
            **({} if actor.discrete else {"log_std_init": float(np.log(0.6))}),
        },
    )
    trainer = Sb3Trainer(
        model,
        env,
        partial(exported, model, actor),
        epochs,
        partial(world_seed, seed, worlds=worlds),
        Return,
    )
    return Training(
        module=actor,
        collector=trainer,
        trainer=trainer,
        score=partial(score, actor, score_worlds),
    )
