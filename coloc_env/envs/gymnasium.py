"""The Gymnasium face: one UAV of a team; a policy that is given acts for the others."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import torch

from coloc_env.envs.action_checks import checked_arrays
from coloc_env.envs.action_mode import ActionMode
from coloc_env.envs.actions import chosen_leaves, make_mode
from coloc_env.envs.pettingzoo import CoLocParallelEnv
from coloc_env.observation import box, flat_box, stack
from coloc_env.scenario import Scenario
from coloc_env.scenarios import scenario_from
from coloc_env.seeding import checked_seed


class TeamPolicy(Protocol):
    """Whoever acts for the other UAVs, in the PettingZoo face's terms."""

    def reset(self) -> None:
        """Forget the episode."""

    def __call__(
        self, observations: Mapping[str, Mapping[str, np.ndarray]]
    ) -> dict[str, np.ndarray]:
        """Estimates ``[position (m), velocity (m/s), log-std]`` of its UAVs, world frame."""


class SingleUavEnv(gym.Env[np.ndarray, np.ndarray]):
    """One UAV as a Gymnasium environment; ``others`` acts for the rest of the team.

    ``others`` gets every UAV's observation in each step and gives the estimates of all but ``uav``
    (None: the UAV has no team). ``action``: ``estimate``, ``displacement`` or an ``ActionMode``,
    for this UAV alone. Observations are flat float32 [F]: the ``leaves`` side by side (default:
    those that the action mode recommends, else all). Actions are float32 [a]. The horizon
    truncates. ``agents.wrappers.single_uav`` builds one from names of localizers.

    Raises ValueError for an unknown UAV or leaf, and where UAVs can fail.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium's convention)
        "render_modes": ["human", "rgb_array"]
    }

    def __init__(
        self,
        scenario: str | Scenario = "indoor-v0",
        uav: str = "uav_0",
        others: TeamPolicy | None = None,
        action: str | ActionMode = "displacement",
        leaves: Sequence[str] | None = None,
        render_mode: str | None = None,
        **overrides: Any,
    ) -> None:
        scenario = scenario_from(scenario, overrides)
        if uav not in scenario.agents:
            raise ValueError(f"there is no {uav!r} in the team: {', '.join(scenario.agents)}")
        if scenario.commanded:
            raise ValueError(f"{scenario.name}: steered motion or chosen links need a whole team")
        if others is None and scenario.arena.n_uavs > 1:
            raise ValueError(f"{scenario.name}: others=None is not allowed: a policy for the team")
        self.env = CoLocParallelEnv(scenario, render_mode)
        self.metadata = {**self.metadata, "render_fps": self.env.metadata["render_fps"]}
        self.render_mode, self.uav, self.scenario = render_mode, uav, scenario
        self.others, self.mode = others, make_mode(scenario, action)
        self._memory: Any = None
        self._started = False
        chosen = chosen_leaves(scenario, self.mode, leaves)
        self.leaves = tuple(chosen)
        self.observation_space = flat_box(chosen)
        self.action_space = box(self.mode.bounds)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode: the world of ``seed``; without one, of the seed after the last (the
        first time: a random one). The info has it."""
        if seed is not None:
            seed = checked_seed(seed, self.scenario.name)
        super().reset(seed=seed)
        self._observations, infos = self.env.reset(seed=seed)
        if self.others is not None:
            self.others.reset()
        self._memory = self.mode.reset(stack([self._observations[self.uav]]))
        self._started = True
        return self._observe(), infos[self.uav]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Score the UAV's estimate, and move everybody on. ValueError, which says what is needed,
        for an action that does not fit."""
        if not self._started:
            raise ValueError(f"{self.scenario.name}: call reset() first")
        uav = self.uav
        own = checked_arrays(self.scenario, self.mode, {uav: action}, [uav])
        self._memory, estimate = self.mode.estimate(self._memory, torch.from_numpy(own[None]))
        actions = {} if self.others is None else self.others(self._observations)
        actions = {**actions, uav: estimate[0, 0].numpy()}
        self._observations, rewards, terminated, truncated, infos = self.env.step(actions)
        return self._observe(), rewards[uav], terminated[uav], truncated[uav], infos[uav]

    def render(self) -> Any:
        """The world now: an RGB array [H, W, 3] uint8, or a window (``human``)."""
        return self.env.render()

    def close(self) -> None:
        """Close the window, if any."""
        self.env.close()

    def _observe(self) -> np.ndarray:
        """The chosen leaves of the UAV's own observation."""
        own = stack([self._observations[self.uav]])
        self._memory, leaves = self.mode.observe(self._memory, own)
        found = {**own.leaves, **leaves}
        return torch.cat([found[name] for name in self.leaves], -1)[0, 0].numpy()
