"""The PettingZoo face: one world, numpy in and out."""

import math
from collections.abc import Mapping
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import torch
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import OrderEnforcingWrapper
from pettingzoo.utils.conversions import parallel_to_aec_wrapper

from coloc_env.envs.action_checks import checked_arrays
from coloc_env.envs.action_mode import ActionMode, Leaves
from coloc_env.envs.actions import action_space, make_mode, observed_leaves
from coloc_env.envs.mode_runner import ModeRunner
from coloc_env.observation import all_leaves, box, flat_box, observation_space
from coloc_env.render import Renderer
from coloc_env.scenario import Scenario
from coloc_env.scenarios import scenario_from
from coloc_env.seeding import checked_seed, random_seed
from coloc_env.world import World

RENDER_MODES = ("human", "rgb_array")

T = TypeVar("T")


class CoLocParallelEnv(ParallelEnv[str, dict[str, np.ndarray], np.ndarray]):
    """Cooperative localization as a PettingZoo parallel environment.

    Each UAV's observation is a Dict of 1-D float32 Boxes; its action is a flat Box
    ``[position (m), velocity (m/s), log-std of the position]`` in the world frame, the estimate of
    the state at the very step observed; its reward −‖p̂ − p‖ by default. The horizon truncates; a
    failed UAV terminates. Infos are flat and numeric: ``error`` of the step just scored (m),
    ``scored``, the episode's ``episode_rmse``, ``episode_mean``, ``episode_max`` so far, and the
    world's ``seed``. What is done to observations in place reaches nobody else.

    That is ``action="estimate"``. For learners: ``action="displacement"``, or any ``ActionMode``
    (``coloc_env.envs.actions``), with an action of its own and more leaves.
    """

    metadata = {  # noqa: RUF012 (PettingZoo's own convention)
        "name": "coloc",
        "render_modes": list(RENDER_MODES),
        "is_parallelizable": True,
    }

    def __init__(
        self,
        scenario: Scenario,
        render_mode: str | None = None,
        action: str | ActionMode = "estimate",
    ) -> None:
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(
                f"render_mode={render_mode!r} is not allowed: None, {', '.join(RENDER_MODES)}"
            )
        self.scenario = scenario
        self.render_mode = render_mode
        fps = max(1, round(1 / scenario.arena.dt))
        self.metadata = {**self.metadata, "name": scenario.name, "render_fps": fps}
        self.world = World(scenario)
        self.mode = make_mode(scenario, action)
        self.possible_agents = scenario.agents[: self.mode.n_agents]
        self.agents: list[str] = []
        self._index = {agent: i for i, agent in enumerate(self.possible_agents)}
        self._runner = ModeRunner(self.mode, self.world)
        seen = observed_leaves(scenario, self.mode)
        space: gym.spaces.Space[Any] = observation_space(seen)
        if self.mode.whole and self.mode.flat:
            space = flat_box({"observation": seen["observation"]})
        actions = action_space(self.mode)
        self.observation_spaces = dict.fromkeys(self.possible_agents, space)
        self.action_spaces = dict.fromkeys(self.possible_agents, actions)
        self.state_space = box(self.mode.state_bounds(scenario))
        self._next_seed: int | None = None
        self._can_fail = bool(scenario.failure_rate or scenario.failures)
        self._window: _Window
        self._renderer = None if render_mode is None else Renderer(scenario)

    def observation_space(self, agent: str) -> gym.spaces.Space[Any]:
        """The same space object for every agent and call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gym.spaces.Space[Any]:
        """The same space object for every agent and call."""
        return self.action_spaces[agent]

    def with_action(self, action: str | ActionMode) -> "CoLocParallelEnv":
        """The same environment in another action mode."""
        return CoLocParallelEnv(self.scenario, self.render_mode, action)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, dict[str, float]]]:
        """Start an episode: the world of ``seed``; without one, of the seed after the last (the
        first time: a random one). Infos have it. ValueError for a seed that is no whole number
        from 0 to 2⁶²."""
        if seed is None:
            seed = random_seed() if self._next_seed is None else self._next_seed
        self.seed = checked_seed(seed, self.scenario.name)
        self._next_seed = self.seed + 1
        self.agents = list(self.possible_agents)
        self.world.restart([self.seed])
        self._window = _Window(self.world)
        self._tallies = {agent: _Tally(self.seed) for agent in self.agents}
        if self._renderer is not None:
            self._renderer.reset()
        infos = {agent: tally.info(0.0, False) for agent, tally in self._tallies.items()}
        leaves = self._runner.reset()
        return self._observe(leaves), self._masked(infos, leaves)

    def step(
        self, actions: Mapping[str, np.ndarray]
    ) -> tuple[
        dict[str, dict[str, np.ndarray]],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, float]],
    ]:
        """Score the estimates of the step observed last, then move to the next.

        Raises ValueError for a missing or unknown agent, a wrong shape, NaN or infinity. Actions
        of UAVs that have failed are ignored (TorchRL's ``PettingZooWrapper`` goes on sending them).
        """
        if not self.agents:
            raise ValueError(f"{self.scenario.name}: the episode is over; call reset() first")
        acting, world = self.agents, self.world
        estimates = self._runner.estimate(self._actions_of(actions))
        if self._renderer is not None:
            self._renderer.record(world, estimates)
        scored = self._of(self._window.scored[world.cursor])
        step = self._runner.step(estimates)
        leaves = self._runner.observe()
        observations = self._observe(leaves)
        errors, rewards = self._of(step.error.tolist()[0]), self._of(step.reward.tolist()[0])
        infos = {a: self._tallies[a].add(errors[a], scored[a]) for a in acting}
        infos = self._masked(infos, leaves)
        over = self._window.over[world.cursor]
        terminated, truncated = dict.fromkeys(acting, False), dict.fromkeys(acting, over)
        if self._can_fail:
            for i in np.flatnonzero(self._window.failed[world.cursor]):
                failed = self.possible_agents[i]
                terminated[failed], truncated[failed] = True, False
        if over:
            self.agents = []
        elif self._can_fail:
            self.agents = [a for a in acting if not terminated[a]]
        return observations, rewards, terminated, truncated, infos

    def state(self) -> np.ndarray:
        """Privileged truth: per UAV position, velocity, attitude, alive, scored; then the errors of
        what actions are relative to, if they are."""
        self._started()
        return self._runner.state().numpy()[0]

    def render(self) -> np.ndarray | None:
        """The scene now: an RGB array [H, W, 3] uint8, or a window (``human``)."""
        if self.render_mode is None or self._renderer is None:
            raise ValueError(f"render() needs a render_mode: {' or '.join(RENDER_MODES)}")
        self._started()
        return self._renderer.render(self.world, self.render_mode)

    def close(self) -> None:
        """Close the window, if any."""
        if self._renderer is not None:
            self._renderer.close()

    # ------------------------------------------------------------------ inner

    def _started(self) -> None:
        if self.world.cursor < 0:
            raise ValueError(f"{self.scenario.name}: call reset() first")

    def _actions_of(self, actions: Mapping[str, np.ndarray]) -> torch.Tensor:
        """Actions as one tensor [1, N, A]; a failed UAV's slot is zero."""
        agents, count = self.agents, len(self.possible_agents)
        if not (actions.keys() >= set(agents) and actions.keys() <= self._index.keys()):
            missing = [a for a in agents if a not in actions]
            unknown = [a for a in actions if a not in self._index]
            what = f"no action for {missing[0]}" if missing else f"there is no agent {unknown[0]!r}"
            raise ValueError(f"{self.scenario.name}: {what}; acting now: {', '.join(agents)}")
        stacked = checked_arrays(self.scenario, self.mode, actions, agents)
        if len(agents) < count:
            acting, stacked = stacked, np.zeros((count, *self.mode.shape), np.float32)
            stacked[[self._index[a] for a in agents]] = acting
        return torch.from_numpy(stacked[None])

    def _masked(self, infos: dict[str, Any], leaves: Leaves) -> dict[str, Any]:
        """Infos with ``action_mask`` [choices] int8, where actions are choices."""
        if "action_mask" in leaves:
            masks = self._of(list(leaves["action_mask"].numpy()[0].astype(np.int8)))
            infos = {agent: {**info, "action_mask": masks[agent]} for agent, info in infos.items()}
        return infos

    def _of(self, every: list[T]) -> dict[str, T]:
        """The acting agents' entries of a list of all."""
        if len(self.agents) == len(every):
            return dict(zip(self.agents, every, strict=True))
        return {agent: every[self._index[agent]] for agent in self.agents}

    def _observe(self, leaves: Leaves) -> dict[str, Any]:
        """Each agent's leaves, ``leaves`` of the action mode included: rows of copies that nobody
        else has."""
        world, window = self.world, self._window
        if world.sensed is not window.sensed:
            self._window = window = _Window(world)
        if self.mode.whole and self.mode.flat:
            return self._of(list(leaves["observation"].numpy()[0]))
        if self.mode.whole:
            parts = zip(*(leaf.numpy()[0] for leaf in leaves.values()), strict=True)
            return self._of([dict(zip(leaves, each, strict=True)) for each in parts])
        k = world.cursor
        now = [leaf[k] for leaf in window.leaves]
        now[window.messages_at] = world.messages().numpy()[0]
        names = window.names
        if leaves:
            now += [leaf.numpy()[0] for leaf in leaves.values()]
            names = (*names, *leaves)
        return self._of([dict(zip(names, row)) for row in zip(*now, strict=True)])  # noqa: B905


class _Window:
    """A window of the one world as arrays and lists [K, …], copied once; leaves in the order of the
    spaces, with room for the messages, which no window has."""

    def __init__(self, world: World) -> None:
        self.sensed = sensed = world.sensed
        self.over: list[bool] = sensed.over.tolist()[0]
        self.scored: list[list[bool]] = sensed.scored.tolist()[0]
        self.failed = sensed.failed.numpy()[0]
        each = (sensed.count, 1, 1)
        leaves = {name: leaf.numpy()[0].copy() for name, leaf in sensed.leaves.items()}
        leaves |= {name: np.tile(leaf.numpy(), each) for name, leaf in world.static.items()}
        self.names = tuple(all_leaves(world.scenario))
        self.messages_at = self.names.index("messages")
        self.leaves = [leaves.get(name, self.over) for name in self.names]


class _Tally:
    """One UAV's errors in an episode so far, for its infos."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._count, self._sum, self._squares, self._largest = 0, 0.0, 0.0, 0.0

    def add(self, error: float, scored: bool) -> dict[str, float]:
        """The info after a step with this error in m (0 where it is not scored)."""
        self._count += scored
        self._sum += error
        self._squares += error * error
        self._largest = max(self._largest, error)
        return self.info(error, scored)

    def info(self, error: float, scored: bool) -> dict[str, float]:
        count = self._count or 1
        return {
            "error": error,
            "scored": float(scored),
            "episode_rmse": math.sqrt(self._squares / count),
            "episode_mean": self._sum / count,
            "episode_max": self._largest,
            "seed": self._seed,
        }


class _Cycle(parallel_to_aec_wrapper):
    """PettingZoo's agent-environment cycle, each observation of which is a copy."""

    def observe(self, agent: str) -> Any:
        """What the agent observes until all have acted."""
        seen = super().observe(agent)
        if isinstance(seen, dict):
            return {name: leaf.copy() for name, leaf in seen.items()}
        return seen.copy()


def parallel_env(
    scenario: str | Scenario = "indoor-v0",
    render_mode: str | None = None,
    action: str | ActionMode = "estimate",
    **overrides: Any,
) -> CoLocParallelEnv:
    """The environment of a scenario id with overrides, or of a Scenario."""
    return CoLocParallelEnv(scenario_from(scenario, overrides), render_mode, action)


def env(
    scenario: str | Scenario = "indoor-v0",
    render_mode: str | None = None,
    action: str | ActionMode = "estimate",
    **overrides: Any,
) -> AECEnv:
    """The same environment in PettingZoo's agent-environment-cycle form."""
    made = parallel_env(scenario, render_mode, action, **overrides)
    return OrderEnforcingWrapper(_Cycle(made))
