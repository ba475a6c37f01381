"""stable-baselines3's PPO on coloc's ``VecEnv``, resumable, its policy an agent like any other."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize
from torch import Tensor

from agents.policies.actor import Actor
from agents.policies.learned import actor_for
from agents.wrappers.correction import learners_mode
from coloc_env.envs.sb3 import CoLocVecEnv
from coloc_env.options import Factor, PositiveCount, Share
from coloc_env.scenarios import parse_scenario
from training.learning.collectors import (
    Epochs,
    ScoreRuns,
    Seed,
    Steps,
    Width,
    Worlds,
    require_batches,
    world_seed,
)
from training.learning.mappo import score
from training.learning.run import Training

_RUNNING = ("obs_rms", "ret_rms")


def exported(model: PPO, normal: VecNormalize, actor: Actor) -> None:
    """Write a PPO ``MlpPolicy`` (two tanh layers, a state-independent log-std) and the statistics
    of its ``VecNormalize`` into ``actor``, in place: the same best actions to rounding."""
    policy: Any = model.policy
    statistics: Any = normal.obs_rms
    first, _, second, _ = policy.mlp_extractor.policy_net
    layers: Any = actor.body.layers
    with torch.no_grad():
        actor.body.normal.shift.copy_(torch.as_tensor(statistics.mean))
        scale = np.sqrt(statistics.var + normal.epsilon)
        actor.body.normal.scale.copy_(torch.as_tensor(scale))
        for ours, theirs in ((layers[0], first), (layers[1], second)):
            ours.weight.copy_(theirs.weight)
            ours.bias.copy_(theirs.bias)
        n = policy.action_net.out_features
        actor.head.layer.weight.zero_()
        actor.head.layer.weight[:n] = policy.action_net.weight
        actor.head.layer.bias[:n] = policy.action_net.bias
        actor.head.layer.bias[n:] = policy.log_std


class Sb3Trainer:
    """Epochs of ``PPO.learn`` over fresh worlds, as ``training.learning.run`` runs them: both its
    trainer and its epochs. Everything that an epoch draws depends on the epoch alone.

    ``export`` writes what was learned into what is saved; ``figures`` makes a callback that logs
    what rewards say of a rollout.
    """

    def __init__(
        self,
        model: PPO,
        env: VecNormalize,
        export: Callable[[], None],
        epochs: int,
        first: Callable[[int], int],
        figures: Callable[[], BaseCallback],
    ) -> None:
        self.model, self.env, self.export, self.figures = model, env, export, figures
        self.epoch, self.epochs, self.first = 0, epochs, first
        self.rate = model.lr_schedule(1.0)
        self.collected_frames = 0
        self.logger: Any = None
        self.on_epoch_end: Callable[[int], None] = lambda epochs: None

    def train(self) -> None:
        self.model.set_logger(Logger(None, [_Metrics(self)]))
        worlds: Any = self.env.venv
        frames = worlds.num_envs * worlds.scenario.horizon
        while self.epoch < self.epochs:
            seed = self.first(self.epoch)
            torch.manual_seed(seed)
            np.random.seed(seed % 2**32)  # noqa: NPY002 (what SB3 draws its minibatches from)
            worlds.seed(seed)
            self.model._last_obs = None  # the epoch's worlds start now
            rate = self.rate * (1 - self.epoch / self.epochs)
            self.model.lr_schedule = partial(_constant, rate)
            self.model.learn(
                frames, self.figures(), log_interval=frames + 1, reset_num_timesteps=False
            )
            self.collected_frames = self.model.num_timesteps
            self.epoch += 1
            self.export()
            self.on_epoch_end(self.epoch)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next epoch depends on."""
        return {
            "epoch": self.epoch,
            "frames": self.collected_frames,
            "updates": self.model._n_updates,
            "policy": dict(self.model.policy.state_dict()),
            "optimizer": self.model.policy.optimizer.state_dict(),
            **{key: _numbers(getattr(self.env, key)) for key in self._running},
        }

    @property
    def _running(self) -> list[str]:
        """The statistics that ``VecNormalize`` keeps."""
        return [key for key in _RUNNING if getattr(self.env, key, None) is not None]

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.epoch, self.collected_frames = state_dict["epoch"], state_dict["frames"]
        self.model.num_timesteps = state_dict["frames"]
        self.model._n_updates = state_dict["updates"]
        self.model.policy.load_state_dict(state_dict["policy"])
        self.model.policy.optimizer.load_state_dict(state_dict["optimizer"])
        for key in self._running:
            mean, var, count = state_dict[key]
            running: Any = getattr(self.env, key)
            running.mean, running.var, running.count = mean.numpy(), var.numpy(), count
        self.export()


def _numbers(running: RunningMeanStd) -> list[Tensor | float]:
    return [torch.as_tensor(running.mean), torch.as_tensor(running.var), float(running.count)]


def _constant(rate: float, left: float) -> float:
    """A learning rate that stays for an epoch, whatever is left of it."""
    return rate


class _Errors(BaseCallback):
    """Logs the RMSE (m) of a rollout whose rewards are −error, with PPO's figures of training on it
    (SB3 itself would keep those until after the next rollout, when the state has been saved)."""

    def _on_rollout_start(self) -> None:
        self.squares: list[float] = []
        self.logger.dump(self.num_timesteps)

    def _on_step(self) -> bool:
        env: Any = self.training_env
        self.squares.append(float(np.square(env.get_original_reward()).mean()))
        return True

    def _on_rollout_end(self) -> None:
        self.logger.record("rmse", float(np.sqrt(np.mean(self.squares))))

    def _on_training_end(self) -> None:
        self.logger.dump(self.num_timesteps)


class _Metrics(KVWriter):
    """What SB3 logs, into the run's own logger."""

    def __init__(self, trainer: Sb3Trainer) -> None:
        self.trainer = trainer

    def write(self, key_values: dict[str, Any], key_excluded: Any, step: int = 0) -> None:
        for key, value in key_values.items():
            if isinstance(value, (int, float, np.number)) and not key.startswith("time/"):
                self.trainer.logger.log_scalar(key.split("/")[-1], float(value), step)

    def close(self) -> None: ...


def sb3_ppo(
    *,
    scenario: str = "indoor-v0:motion=random:horizon=200",
    base: str = "ekf",
    feedback: Share = 0.0,
    hidden: Width = 64,
    worlds: Worlds = 128,
    epochs: Epochs = 20,
    steps: Steps = 25,
    passes: PositiveCount = 4,
    minibatches: PositiveCount = 8,
    learning_rate: Factor = 1e-3,
    gamma: Share = 0.0,
    clip: Factor = 0.2,
    seed: Seed = 0,
    score_runs: ScoreRuns = 40,
) -> Training:
    """A policy for every UAV by stable-baselines3's PPO, with shared parameters.

    It corrects the estimates of a ``base`` localizer, or, with ``base=none``, localizes alone;
    ``VecNormalize`` normalizes what it sees and its rewards. Options as ``coloc train ippo`` has
    them.
    """
    name = "sb3-ppo"
    parsed = parse_scenario(scenario)
    require_batches(name, [parsed], steps)
    if parsed.horizon % steps:
        raise ValueError(f"{name}: steps={steps} must divide the horizon, {parsed.horizon}")
    mode = learners_mode(parsed.believed, base, feedback)
    worlds_env = CoLocVecEnv(parsed, worlds, action=mode)
    env = VecNormalize(worlds_env, gamma=gamma)
    rows = worlds_env.num_envs * steps
    if 2 * minibatches > rows:
        raise ValueError(f"{name}: minibatches={minibatches} is not allowed: at most {rows // 2}")
    model = PPO(
        "MlpPolicy",
        env,
        learning_rate=learning_rate,
        n_steps=steps,
        batch_size=-(-rows // minibatches),
        n_epochs=passes,
        gamma=gamma,
        clip_range=clip,
        ent_coef=0.0,
        seed=seed,
        device="cpu",
        policy_kwargs={"net_arch": [hidden, hidden], "log_std_init": float(np.log(0.3))},
    )
    actor = actor_for(mode, hidden=hidden, squash="clip")
    export, first = partial(exported, model, env, actor), partial(world_seed, seed, worlds=worlds)
    trainer = Sb3Trainer(model, env, export, epochs, first, _Errors)
    return Training(
        module=actor,
        collector=trainer,
        trainer=trainer,
        score=partial(score, name, actor, [parsed], score_runs),
    )
