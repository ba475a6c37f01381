"""skrl's own wrapper on tasks and on displacements (where skrl is installed). It flattens Dicts
itself, and looks at the unwrapped environment's spaces: ``Flatten`` must not be between."""

from typing import Any

import gymnasium as gym
import pytest
import torch

from agents import tasks
from coloc_env import parallel_env

skrl = pytest.importorskip("skrl.envs.wrappers.torch")


def displaced() -> Any:
    return parallel_env("indoor-v0", action="displacement", motion="random", n_uavs=3)


@pytest.mark.parametrize(
    "make",
    [displaced, lambda: tasks.parallel_env("survey-v0"), lambda: tasks.parallel_env("schedule-v0")],
    ids=["displacement", "survey", "schedule"],
)
def test_it_wraps_the_parallel_face(make: Any) -> None:
    env = skrl.wrap_env(make(), wrapper="pettingzoo")
    observations, _ = env.reset()
    for _ in range(3):
        actions = {}
        for name in env.agents:
            drawn = torch.as_tensor(env.action_spaces[name].sample())
            actions[name] = drawn.reshape(1, -1)
        observations, rewards, terminated, truncated, _ = env.step(actions)
    states = env.state()
    for name, space in env.observation_spaces.items():
        assert observations[name].shape == (1, gym.spaces.flatdim(space))
        assert states[name].shape == (1, env.state_spaces[name].shape[0])
        assert rewards[name].shape == terminated[name].shape == truncated[name].shape == (1, 1)
        assert rewards[name].isfinite().all()
