"""skrl's independent PPO on the PettingZoo face, by displacements: one policy for all UAVs.

skrl flattens Dict observations itself and looks at the unwrapped environment's spaces: ``Flatten``
must not be between. Its PettingZoo wrapper runs one world; the UAVs share their networks, each with
an optimizer and a memory of its own. A trap: its configuration refuses its own empty defaults of
keywords, which must be given by UAV.

    pip install -e . "skrl==2.1.1"
    python -m training.examples.skrl_ippo
"""

import tempfile
import time
from typing import Any

import gymnasium as gym
import torch
from skrl import config
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.multi_agents.torch import ExperimentCfg
from skrl.multi_agents.torch.ippo import IPPO, IPPO_CFG
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer
from torch import Tensor, nn

from coloc_env import parallel_env


def layers(size_in: int, size_out: int) -> nn.Sequential:
    hidden = (nn.Linear(size_in, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh())
    return nn.Sequential(*hidden, nn.Linear(64, size_out))


class Policy(GaussianMixin, Model):
    """Means from the observation; one standard deviation an axis, whatever is observed."""

    def __init__(self, observation_space: gym.Space[Any], action_space: gym.Space[Any]) -> None:
        Model.__init__(self, observation_space=observation_space, action_space=action_space)
        GaussianMixin.__init__(self, clip_actions=True)
        self.net = layers(self.num_observations, self.num_actions)
        self.log_std = nn.Parameter(torch.full((self.num_actions,), -1.0))

    def compute(self, inputs: dict[str, Tensor], role: str) -> tuple[Tensor, dict[str, Tensor]]:
        return self.net(inputs["observations"]).tanh(), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """The critic, of the observation alone."""

    def __init__(self, observation_space: gym.Space[Any], action_space: gym.Space[Any]) -> None:
        Model.__init__(self, observation_space=observation_space, action_space=action_space)
        DeterministicMixin.__init__(self)
        self.net = layers(self.num_observations, 1)

    def compute(self, inputs: dict[str, Tensor], role: str) -> tuple[Tensor, dict[str, Tensor]]:
        return self.net(inputs["observations"]), {}


def world(horizon: int, seed: int) -> Any:
    """The wrapped environment, whose first world is ``seed``'s and the next ones those after."""
    config.torch.key = seed
    env = parallel_env("indoor-v0", action="displacement", motion="random", horizon=horizon)
    return wrap_env(env, wrapper="pettingzoo")


@torch.no_grad()
def mean_error(agent: IPPO, env: Any, episodes: int) -> float:
    """Mean error (m) of the mean actions in the next worlds of ``env``."""
    agent.enable_training_mode(False)
    errors: list[float] = []
    for _ in range(episodes):
        seen, infos = env.reset()
        while env.agents:
            _, found = agent.act(seen, env.state(), timestep=0, timesteps=0)
            means = {name: each["mean_actions"] for name, each in found.items()}
            seen, *_, infos = env.step(means)
        errors += [info["episode_mean"] for info in infos.values()]
    return sum(errors) / len(errors)


def main(
    steps: int = 15_000, horizon: int = 100, episodes: int = 5, seed: int = 0
) -> dict[str, float]:
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    train, score = world(horizon, 1_000_000 * (seed + 1)), world(horizon, 0)
    names, rollouts = train.possible_agents, 2 * horizon
    seen, acts = train.observation_space(names[0]), train.action_space(names[0])
    models = {"policy": Policy(seen, acts), "value": Value(seen, acts)}
    folder = tempfile.mkdtemp(prefix="coloc-skrl-")
    agent = IPPO(
        possible_agents=names,
        models=dict.fromkeys(names, models),
        memories={name: RandomMemory(memory_size=rollouts, num_envs=1) for name in names},
        observation_spaces=train.observation_spaces,
        state_spaces=train.state_spaces,
        action_spaces=train.action_spaces,
        device="cpu",
        cfg=IPPO_CFG(
            rollouts=rollouts,
            learning_epochs=4,
            mini_batches=4,
            discount_factor=0.0,  # what an action is worth shows at once, in this step's error
            learning_rate=1e-3,
            learning_rate_scheduler_kwargs={name: {} for name in names},
            state_preprocessor_kwargs={name: {} for name in names},
            observation_preprocessor=RunningStandardScaler,
            observation_preprocessor_kwargs={"size": seen, "device": "cpu"},
            value_preprocessor=RunningStandardScaler,
            value_preprocessor_kwargs={"size": 1, "device": "cpu"},
            experiment=ExperimentCfg(write_interval=0, checkpoint_interval=0, directory=folder),
        ),
    )
    before = mean_error(agent, score, episodes)
    start = time.perf_counter()
    trainer = {"timesteps": steps, "headless": True, "disable_progressbar": True}
    SequentialTrainer(env=train, agents=agent, cfg=trainer).train()
    speed = steps * len(names) / (time.perf_counter() - start)
    after = mean_error(agent, world(horizon, 0), episodes)
    print(f"mean error {before:.2f} m before, {after:.2f} m after {steps * len(names)} agent-steps")
    print(f"{speed:,.0f} agent-steps/s")
    return {"before": before, "after": after, "speed": speed}


if __name__ == "__main__":
    main()
