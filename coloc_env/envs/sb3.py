"""The stable-baselines3 face: every UAV of B worlds an environment of a ``VecEnv``."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from jaxtyping import Float32
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvStepReturn
from torch import Tensor

from coloc_env.envs.action_checks import checked_tensor
from coloc_env.envs.action_mode import ActionMode
from coloc_env.envs.actions import action_space, chosen_leaves, make_mode
from coloc_env.envs.mode_runner import ModeRunner
from coloc_env.observation import flat_box
from coloc_env.render import Renderer
from coloc_env.scenario import Scenario
from coloc_env.scenarios import scenario_from
from coloc_env.seeding import checked_seed, random_seed
from coloc_env.world import World

Array = NDArray[np.float32]


class SubEnv:
    """One UAV of one world, as ``get_attr``, ``set_attr`` and ``env_method`` see it."""

    def __init__(self, env: "CoLocVecEnv", world: int, uav: int) -> None:
        self._env, self.world, self.uav = env, world, uav
        self.agent, self.scenario = f"uav_{uav}", env.scenario
        self.render_mode = env.render_mode_used

    @property
    def seed(self) -> int:
        """Seed of the world that it is in."""
        return int(self._env.world.seeds[self.world])

    def state(self) -> Array:
        """The privileged state of its world."""
        self._env.started()
        return self._env.runner.state()[self.world].numpy().copy()


class CoLocVecEnv(VecEnv):
    """``num_worlds`` worlds of N UAVs as ``num_worlds`` · N environments that share a policy.

    Index i is UAV i mod N of world i // N. Observations are flat: the ``leaves`` side by side
    (default: those that the action mode recommends, else all). ``action``: ``estimate``,
    ``displacement`` or an ``ActionMode`` (``agents.with_base(env, "ekf")`` for corrections on a
    localizer). At the horizon every environment is truncated (``TimeLimit.truncated``,
    ``terminal_observation``) and restarts. World b starts with seed ``seed + b``, and moves on
    by ``num_worlds`` an episode; ``seed(s)`` sets that for the next ``reset()``. (So does
    stable-baselines3's ``PPO(seed=s)``: call ``seed`` after making the model.) Without ``seed`` the
    first is random; ``first_seed`` and each environment's ``reset_infos["seed"]`` say which.

    Raises ValueError where UAVs can fail: those of one world end together.
    """

    def __init__(
        self,
        scenario: str | Scenario = "indoor-v0",
        num_worlds: int = 1,
        seed: int | None = None,
        action: str | ActionMode = "estimate",
        leaves: Sequence[str] | None = None,
        render_mode: str | None = None,
        **overrides: Any,
    ) -> None:
        scenario = scenario_from(scenario, overrides)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode={render_mode!r} is not allowed: None, rgb_array")
        self.scenario, self.mode = scenario, make_mode(scenario, action)
        self.world = World(scenario, num_worlds)
        self.runner = ModeRunner(self.mode, self.world)
        chosen = chosen_leaves(scenario, self.mode, leaves)
        self.leaves, self._wanted = tuple(chosen), leaves
        self.worlds, self.n_uavs = num_worlds, self.mode.n_agents
        self.render_mode_used = render_mode
        self._renderer = None if render_mode is None else Renderer(scenario)
        pairs = [(b, i) for b in range(num_worlds) for i in range(self.n_uavs)]
        self.sub_envs = [SubEnv(self, b, i) for b, i in pairs]
        given = random_seed() if seed is None else checked_seed(seed, scenario.name)
        self.first_seed = self._next_seed = given
        super().__init__(len(self.sub_envs), flat_box(chosen), action_space(self.mode))

    def with_action(self, action: str | ActionMode) -> "CoLocVecEnv":
        """The same environment, from its first episode on, in another action mode."""
        return CoLocVecEnv(
            self.scenario,
            self.worlds,
            self.first_seed,
            action,
            self._wanted,
            self.render_mode_used,
        )

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Take the worlds of seeds ``seed``, ``seed + 1``, … at the next reset (None: go on as
        before); the world's seed for each environment."""
        if seed is not None:
            self._next_seed = checked_seed(seed, self.scenario.name)
        return [self._next_seed + sub_env.world for sub_env in self.sub_envs]

    def reset(self) -> Array:
        self.world.restart(self._next_seed)
        self._next_seed += self.worlds
        seeds = self.world.seeds.tolist()
        self.reset_infos = [{"seed": seeds[sub_env.world]} for sub_env in self.sub_envs]
        if self._renderer is not None:
            self._renderer.reset()
        return self._flat(self.runner.reset())

    def step_async(self, actions: np.ndarray) -> None:
        self.started()
        rows = np.array(actions)
        shape = (self.num_envs, *self.mode.shape)
        if rows.shape != shape or rows.dtype.kind not in "fiub":
            raise ValueError(
                f"{self.scenario.name}: real numbers of shape {shape} "
                f"are needed, each row {self.mode.meaning}; got {rows.dtype} of shape {rows.shape}"
            )
        each = torch.from_numpy(rows.astype(np.float32))
        each = each.view(self.worlds, self.n_uavs, *self.mode.shape)
        self._actions = checked_tensor(self.scenario, self.mode, each, self.worlds)

    def step_wait(self) -> VecEnvStepReturn:
        estimates = self.runner.estimate(self._actions)
        if self._renderer is not None:
            self._renderer.record(self.world, estimates[:1])
        step = self.runner.step(estimates)
        observation = self._flat(self.runner.observe())
        infos: list[dict[str, Any]] = [{} for _ in self.sub_envs]
        over = bool(step.truncated[0])  # worlds start and end together
        if over:
            for info, last in zip(infos, observation, strict=True):
                info["TimeLimit.truncated"] = True
                info["terminal_observation"] = last
            observation = self.reset()
        rewards = step.reward.flatten().numpy().copy()
        return observation, rewards, np.full(self.num_envs, over), infos

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [getattr(self.sub_envs[i], attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        for i in self._get_indices(indices):
            setattr(self.sub_envs[i], attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        methods = self.get_attr(method_name, indices)
        return [method(*method_args, **kwargs) for method in methods]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None
    ) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """The first world, if there is a render mode."""
        if self._renderer is None:
            return [None]
        self.started()
        return [self._renderer.render(self.world, "rgb_array")]

    def started(self) -> None:
        """ValueError before the first ``reset()``."""
        if self.world.cursor < 0:
            raise ValueError(f"{self.scenario.name}: call reset() first")

    def _flat(self, leaves: dict[str, Float32[Tensor, "B N F"]]) -> Array:
        """The chosen leaves at the current step, a row per UAV."""
        seen = {} if self.mode.whole else self.world.observation().leaves
        parts = [leaves[name] if name in leaves else seen[name] for name in self.leaves]
        return torch.cat(parts, -1).flatten(0, 1).numpy()
