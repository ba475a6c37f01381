"""Teams in which UAVs localize by different methods, and one learner among localizers."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from agents.policies.adapters import ParallelPolicy, check_part
from agents.registry import make
from agents.wrappers.correction import Correction, learners_mode
from coloc_env.envs.actions import chosen_leaves
from coloc_env.envs.pettingzoo import CoLocParallelEnv
from coloc_env.observation import box, flat_box, stack
from coloc_env.scenario import Scenario
from coloc_env.scenarios import scenario_from


class Team:
    """A policy for the PettingZoo face in which each UAV has a localizer of its own:
    ``Team(env.scenario, {"uav_0": "mappo", "uav_1": "ekf", "uav_2": "pfnn"})``.

    Values are agents with their options, as on the command line. UAVs of one method share a
    localizer; each further one costs a step of its own. Call ``reset()`` before every episode, then
    ``actions = team(observations)``. Raises ValueError for an unknown UAV, and for a method that
    has to act for the whole team.
    """

    def __init__(self, scenario: Scenario, methods: Mapping[str, str]) -> None:
        known = scenario.agents
        for uav in methods:
            if uav not in known:
                raise ValueError(f"there is no {uav!r} in the team: {', '.join(known)}")
        self.policies = [
            ParallelPolicy(make(method, scenario), [u for u in methods if methods[u] == method])
            for method in dict.fromkeys(methods.values())
        ]
        for policy in self.policies:
            check_part(policy.localizer, len(policy.agents or known))

    def reset(self) -> None:
        """Forget the episode."""
        for policy in self.policies:
            policy.reset()

    def __call__(
        self, observations: Mapping[str, Mapping[str, np.ndarray]]
    ) -> dict[str, np.ndarray]:
        """Actions of the observed UAVs that belong to the team."""
        return {
            agent: action
            for policy in self.policies
            for agent, action in policy(observations).items()
        }


class SingleUavEnv(gym.Env[np.ndarray, np.ndarray]):
    """One UAV as a Gymnasium environment; a localizer acts for the others.

    ``base``: the UAV's actions are corrections on this localizer's estimates; ``none``:
    displacements of its own last estimate. Observations are flat: the ``leaves`` side by side
    (default: those that the action mode recommends). The horizon truncates.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium's convention)
        "render_modes": ["human", "rgb_array"]
    }

    def __init__(
        self,
        scenario: str | Scenario = "indoor-v0",
        uav: str = "uav_0",
        others: str = "ekf",
        base: str = "ekf",
        leaves: Sequence[str] | None = None,
        render_mode: str | None = None,
        **overrides: Any,
    ) -> None:
        scenario = scenario_from(scenario, overrides)
        self.env = CoLocParallelEnv(scenario, render_mode)
        self.metadata = {**self.metadata, "render_fps": self.env.metadata["render_fps"]}
        self.render_mode, self.uav, self.scenario = render_mode, uav, scenario
        rest = {agent: others for agent in scenario.agents if agent != uav}
        if len(rest) == len(scenario.agents):
            raise ValueError(f"there is no {uav!r} in the team: {', '.join(scenario.agents)}")
        self.others = Team(scenario, rest)
        self.mode = learners_mode(scenario.believed, base)
        if isinstance(self.mode, Correction):
            check_part(self.mode.base, 1)
        self._memory: Any = None
        chosen = chosen_leaves(scenario, self.mode, leaves)
        self.leaves = tuple(chosen)
        self.observation_space = flat_box(chosen)
        self.action_space = box(self.mode.bounds)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode: the world of ``seed``; without one, of the seed after the last."""
        super().reset(seed=seed)
        self._seen, infos = self.env.reset(seed=seed)
        self.others.reset()
        self._memory = self.mode.reset(stack([self._seen[self.uav]]))
        return self._observe(), infos[self.uav]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Score the UAV's estimate, and move everybody on."""
        if self._memory is None:
            raise ValueError(f"{self.scenario.name}: call reset() first")
        chosen = torch.as_tensor(np.asarray(action, np.float32)).view(1, 1, -1)
        if chosen.shape[-1] != len(self.mode.bounds[0]) or not bool(chosen.isfinite().all()):
            raise ValueError(
                f"{self.scenario.name}: {len(self.mode.bounds[0])} finite numbers are needed: "
                f"{self.mode.meaning}"
            )
        self._memory, estimate = self.mode.estimate(self._memory, chosen)
        actions = self.others(self._seen) | {self.uav: estimate[0, 0].numpy()}
        self._seen, rewards, terminated, truncated, infos = self.env.step(actions)
        uav = self.uav
        return self._observe(), rewards[uav], terminated[uav], truncated[uav], infos[uav]

    def render(self) -> Any:
        """The scene now."""
        return self.env.render()

    def close(self) -> None:
        """Close the window, if any."""
        self.env.close()

    def _observe(self) -> np.ndarray:
        """The chosen leaves of the UAV's own observation."""
        own = stack([self._seen[self.uav]])
        self._memory, leaves = self.mode.observe(self._memory, own)
        found = {**own.leaves, **leaves}
        return torch.cat([found[name] for name in self.leaves], -1)[0, 0].numpy()
