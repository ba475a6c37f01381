"""The TorchRL face: many worlds at once, as one group of agents, or each UAV a row of its own."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from coloc_env.envs.action_checks import checked_tensor
from coloc_env.envs.action_mode import ActionMode, Leaves
from coloc_env.envs.actions import chosen_leaves, make_mode, observed_leaves
from coloc_env.envs.mode_runner import ModeRunner
from coloc_env.scenario import Scenario
from coloc_env.scenarios import scenario_from
from coloc_env.seeding import checked_seed, random_seed
from coloc_env.sensing import Sensed
from coloc_env.world import World, steps_ahead

_LONGEST = 128  # steps sensed ahead at most: rollouts are short beside episodes


class CoLocEnv(EnvBase):
    """``num_envs`` worlds of a scenario as one TorchRL environment of batch size [num_envs].

    Keys: ``("uav", "observation", leaf)`` [B, N, F], ``("uav", "action")`` [B, N, A],
    ``("uav", "reward")`` [B, N, 1], ``("uav", "mask")`` [B, N] (UAVs that have not failed),
    ``state`` [B, S] (privileged truth, and the error of what actions are relative to) and root
    ``done``, ``terminated``, ``truncated`` [B, 1]: an episode ends at its horizon, by truncation;
    a world in which every UAV failed terminates. ``group_map`` names the one group.

    Row b of the first episode is the world of seed ``seed + b``, of the next one
    ``seed + b + num_envs``, and so on: the same worlds as the PettingZoo face's. Without ``seed``
    the first is random; ``first_seed`` says which, ``world.seeds`` [B] those of the worlds now.

    ``action``: ``estimate`` (a localizer's), ``displacement``, or an ``ActionMode``; see
    ``coloc_env.envs.actions``.
    """

    def __init__(
        self,
        scenario: str | Scenario = "indoor-v0",
        num_envs: int = 1,
        device: str | torch.device = "cpu",
        seed: int | None = None,
        action: str | ActionMode = "estimate",
        **overrides: Any,
    ) -> None:
        scenario = scenario_from(scenario, overrides)
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        self.scenario = scenario
        self.world = World(scenario, num_envs, device, steps_ahead(scenario, num_envs, _LONGEST))
        self.mode = make_mode(scenario, action)
        self.group_map = {"uav": scenario.agents[: self.mode.n_agents]}
        self._runner = ModeRunner(self.mode, self.world)
        self._sensed: Sensed | None = None
        self._set_seed(random_seed() if seed is None else seed)
        self._make_specs()

    def _make_specs(self) -> None:
        b, n, device = self.batch_size[0], self.mode.n_agents, self.device
        specs = {
            name: Bounded(leaf.low, leaf.high, (b, n, leaf.width), device, torch.float32)
            if leaf.high < float("inf")
            else Unbounded((b, n, leaf.width), device, torch.float32)
            for name, leaf in observed_leaves(self.scenario, self.mode).items()
        }
        masked = specs.pop("action_mask", None) if self.mode.whole else None
        flat = self.mode.whole and self.mode.flat
        leaves = specs["observation"] if flat else Composite(specs, shape=(b, n))
        low, high = (
            torch.tensor(x, dtype=torch.float32, device=device)
            for x in self.mode.state_bounds(self.scenario)
        )
        self.observation_spec = Composite(
            uav=Composite(
                observation=leaves,
                mask=Categorical(2, (b, n), device, dtype=torch.bool),
                **(
                    {}
                    if masked is None
                    else {"action_mask": Binary(masked.shape[-1], masked.shape, device, torch.bool)}
                ),
                shape=(b, n),
            ),
            state=Bounded(
                low.expand(b, -1), high.expand(b, -1), (b, len(low)), device, torch.float32
            ),
            shape=(b,),
        )
        action: Bounded | Categorical
        if self.mode.choices is not None:
            action = Categorical(self.mode.choices, (b, n), device, torch.int64)
        else:
            ends = (torch.tensor(x, dtype=torch.float32, device=device) for x in self.mode.bounds)
            low, high = ends
            shape = (b, n, self._runner.width)
            action = Bounded(low.expand(shape), high.expand(shape), shape, device, torch.float32)
        self._actions = action
        self.action_spec = Composite(uav=Composite(action=action, shape=(b, n)), shape=(b,))
        reward = Unbounded((b, n, 1), device, torch.float32)
        self.reward_spec = Composite(uav=Composite(reward=reward, shape=(b, n)), shape=(b,))
        flag = Binary(1, (b, 1), device, torch.bool)
        self.done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=(b,)
        )

    def with_action(self, action: str | ActionMode) -> "CoLocEnv":
        """The same environment, from the seed that it was given last, in another action mode."""
        b = self.batch_size[0]
        return CoLocEnv(self.scenario, b, self.device, self.first_seed, action)

    @property
    def memory(self) -> Any:
        """The action mode's memory at the step last observed."""
        return self._runner.memory

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """Actions drawn as their spec draws them, written into ``tensordict`` if given. (What every
        ``EnvBase`` does by way of a TensorDict for each level of the spec.)"""
        if tensordict is None:
            tensordict = TensorDict({}, self.batch_size, self.device)
        return tensordict.set(("uav", "action"), self._actions.rand())

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.first_seed = checked_seed(seed, self.scenario.name)
            rows = torch.arange(self.batch_size[0], device=self.device)
            self._seeds = self.first_seed + rows

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        rows = None
        if tensordict is not None and "_reset" in tensordict.keys():  # noqa: SIM118
            rows = tensordict["_reset"].view(-1)
        self.world.restart(self._seeds, rows)
        moved = self._seeds + self.batch_size[0]
        self._seeds = moved if rows is None else torch.where(rows, moved, self._seeds)
        return self._observe(self._runner.reset(rows)).copy()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["uav", "action"]
        action = checked_tensor(self.scenario, self.mode, action, self.batch_size[0])
        step = self._runner.step(self._runner.estimate(action))
        out = self._observe(self._runner.observe())
        out["uav"].set("reward", step.reward.unsqueeze(-1))
        return out

    def _observe(self, leaves: Leaves) -> TensorDictBase:
        """The current step's entries, reward aside; ``leaves`` are the action mode's."""
        if self.world.sensed is not self._sensed:
            self._sensed = self.world.sensed
            self._frames = self._window(self._sensed).unbind(1)
        out = self._frames[self.world.cursor]
        out.set("state", self._runner.state())
        if self.mode.whole:
            if self.mode.flat:
                out["uav"].set("observation", leaves["observation"])
            else:
                parts = {name: leaf for name, leaf in leaves.items() if name != "action_mask"}
                each = TensorDict(parts, out["uav"].shape, device=self.device)
                out["uav"].set("observation", each)
            if "action_mask" in leaves:
                out["uav"].set("action_mask", leaves["action_mask"] > 0)
            return out
        observation = out["uav"]["observation"]
        observation.set("messages", self.world.messages())
        for name, leaf in leaves.items():
            observation.set(name, leaf)
        return out

    def _window(self, sensed: Sensed) -> TensorDict:
        """A window of steps [B, K], copied once: building a TensorDict a step costs more. What is
        done to an observation in place reaches no other step, and not the world."""
        n = self.mode.n_agents
        shape = (*sensed.steps.shape, n)
        entries: dict[str, Any] = {"mask": sensed.alive[:, :, :n]}
        if not self.mode.whole:
            static = {
                name: leaf.unsqueeze(1).expand(*shape, -1)
                for name, leaf in self.world.static.items()
            }
            seen = {**sensed.leaves, **static}
            entries["observation"] = TensorDict(seen, shape, device=self.device)
        uav = TensorDict(entries, shape, self.device)
        truncated = sensed.over.unsqueeze(-1)
        terminated = ~sensed.alive.any(-1, keepdim=True)
        return TensorDict(
            {
                "uav": uav,
                "done": terminated | truncated,
                "terminated": terminated,
                "truncated": truncated,
            },
            shape[:2],
            self.device,
        ).clone()


class PerUavEnv(EnvBase):
    """A ``CoLocEnv`` of B worlds and N UAVs as one of B · N rows, world by world.

    Keys: ``observation`` [B·N, F], the ``leaves`` side by side (default: those that the action mode
    recommends, else all); ``state`` [B·N, S], the world's privileged state once for each of its
    UAVs; ``action`` [B·N, A]; ``reward``, ``done``, ``terminated``, ``truncated`` [B·N, 1]. So
    TorchRL's recurrent modules and single-agent losses apply, with shared parameters.

    Raises ValueError where UAVs can fail: rows of one world end together.
    """

    def __init__(self, env: CoLocEnv, leaves: Sequence[str] | None = None) -> None:
        chosen = chosen_leaves(env.scenario, env.mode, leaves)
        self.worlds, self.n_uavs = env.batch_size[0], env.mode.n_agents
        rows = self.worlds * self.n_uavs
        super().__init__(device=env.device, batch_size=torch.Size([rows]))
        self.env, self.scenario, self.mode, self.leaves = env, env.scenario, env.mode, tuple(chosen)
        width = sum(leaf.width for leaf in chosen.values())
        states = env.observation_spec["state"].shape[-1]
        self.observation_spec = Composite(
            observation=Unbounded((rows, width), self.device, torch.float32),
            state=Unbounded((rows, states), self.device, torch.float32),
            shape=(rows,),
        )
        action = env.full_action_spec["uav", "action"]
        if env.mode.choices is not None:
            self.action_spec = Categorical(env.mode.choices, (rows,), self.device, torch.int64)
        else:
            flat = action.space.low.flatten(0, 1), action.space.high.flatten(0, 1)
            self.action_spec = type(action)(*flat, flat[0].shape, self.device, torch.float32)
        self.reward_spec = Unbounded((rows, 1), self.device, torch.float32)
        flag = Binary(1, (rows, 1), self.device, torch.bool)
        self.done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=(rows,)
        )

    def _set_seed(self, seed: int | None) -> None:
        self.env.set_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        wanted = None
        if tensordict is not None and "_reset" in tensordict.keys():  # noqa: SIM118
            rows = tensordict["_reset"].view(self.worlds, self.n_uavs)
            worlds = rows.any(-1, keepdim=True)
            if not bool((rows == worlds).all()):
                raise ValueError("the UAVs of a world restart together, not one by one")
            wanted = TensorDict({"_reset": worlds}, [self.worlds], self.device)
        return self._flat(self.env._reset(wanted))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"].unflatten(0, (self.worlds, self.n_uavs))
        uav = TensorDict({"action": action}, action.shape[:2], self.device)
        after = self.env._step(TensorDict({"uav": uav}, [self.worlds], self.device))
        out = self._flat(after)
        out.set("reward", after["uav", "reward"].flatten(0, 1))
        return out

    def _flat(self, entries: TensorDictBase) -> TensorDictBase:
        """A step's entries, a row per UAV."""
        seen = entries["uav", "observation"]
        observation = seen
        if not (self.mode.whole and self.mode.flat):
            observation = torch.cat([seen[name] for name in self.leaves], -1)
        flags = ("done", "terminated", "truncated")
        return TensorDict(
            {
                "observation": observation.flatten(0, 1),
                **{name: self._each(entries[name]) for name in ("state", *flags)},
            },
            self.batch_size,
            self.device,
        )

    def _each(self, entry: Tensor) -> Tensor:
        """A world's entry [B, F] once for each of its UAVs."""
        return entry.repeat_interleave(self.n_uavs, 0)
