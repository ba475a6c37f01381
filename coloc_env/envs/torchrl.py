"""The TorchRL face: many worlds at once as an ``EnvBase`` with one group of agents, ``uav``."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from coloc_env.envs.actions import (
    ActionMode,
    Leaves,
    Pilot,
    check,
    make_mode,
    observed_leaves,
    privileged_bounds,
)
from coloc_env.scenario import Scenario
from coloc_env.scenarios import scenario_from
from coloc_env.sensing import Sensed
from coloc_env.world import World


class CoLocEnv(EnvBase):
    """``num_envs`` worlds of a scenario as one TorchRL environment of batch size [num_envs].

    Keys: ``("uav", "observation", leaf)`` [B, N, F], ``("uav", "action")`` [B, N, A],
    ``("uav", "reward")`` [B, N, 1], ``("uav", "mask")`` [B, N] (UAVs that have not failed),
    ``state`` [B, S] (privileged truth, and the error of what actions are relative to) and root
    ``done``, ``terminated``, ``truncated`` [B, 1]: an episode ends at its horizon, by truncation;
    a world in which every UAV failed terminates.

    Row b of the first episode is the world of seed ``seed + b``, of the next one
    ``seed + b + num_envs``, and so on: the same worlds as the PettingZoo face's.

    ``action``: ``estimate`` (a localizer's), ``displacement``, or an ``ActionMode``; see
    ``coloc_env.envs.actions``.
    """

    def __init__(
        self,
        scenario: str | Scenario = "indoor-v0",
        num_envs: int = 1,
        device: str | torch.device = "cpu",
        seed: int = 0,
        action: str | ActionMode = "estimate",
        **overrides: Any,
    ) -> None:
        scenario = scenario_from(scenario, overrides)
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        self.scenario = scenario
        self.world = World(scenario, num_envs, device)
        self.mode = make_mode(scenario, action)
        self._pilot = Pilot(self.mode, self.world)
        self._sensed: Sensed | None = None
        self._set_seed(seed)
        self._make_specs()

    def _make_specs(self) -> None:
        b, n, device = self.batch_size[0], self.scenario.arena.n_uavs, self.device
        leaves = {
            name: Bounded(leaf.low, leaf.high, (b, n, leaf.width), device, torch.float32)
            if leaf.high < float("inf")
            else Unbounded((b, n, leaf.width), device, torch.float32)
            for name, leaf in observed_leaves(self.scenario, self.mode).items()
        }
        low, high = (
            torch.tensor(x, device=device) for x in privileged_bounds(self.scenario, self.mode)
        )
        self.observation_spec = Composite(
            uav=Composite(
                observation=Composite(leaves, shape=(b, n)),
                mask=Categorical(2, (b, n), device, dtype=torch.bool),
                shape=(b, n),
            ),
            state=Bounded(low.expand(b, -1), high.expand(b, -1), (b, len(low)), device),
            shape=(b,),
        )
        low, high = (torch.tensor(x, device=device) for x in self.mode.bounds)
        shape = (b, n, self._pilot.width)
        action = Bounded(low.expand(shape), high.expand(shape), shape, device, torch.float32)
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
        return CoLocEnv(self.scenario, b, self.device, self._first_seed, action)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            rows = torch.arange(self.batch_size[0], device=self.device)
            self._seeds = int(seed) + rows
            self._first_seed = int(seed)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        rows = None
        if tensordict is not None and "_reset" in tensordict.keys():  # noqa: SIM118
            rows = tensordict["_reset"].view(-1)
        self.world.reset(self._seeds, rows)
        moved = self._seeds + self.batch_size[0]
        self._seeds = moved if rows is None else torch.where(rows, moved, self._seeds)
        return self._observe(self._pilot.reset(rows)).copy()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["uav", "action"]
        check(self.scenario, self.mode, action, self.batch_size[0])
        step = self.world.step(self._pilot.estimate(action))
        out = self._observe(self._pilot.observe())
        out["uav"].set("reward", step.reward.unsqueeze(-1))
        return out

    def _observe(self, leaves: Leaves) -> TensorDictBase:
        """The current step's entries, reward aside; ``leaves`` are the action mode's."""
        if self.world.sensed is not self._sensed:
            self._sensed = self.world.sensed
            self._frames = self._window(self._sensed).unbind(1)
        out = self._frames[self.world.cursor]
        observation = out["uav", "observation"]
        messages, heard = self.world.messages()
        observation.set("messages", messages)
        observation.set("message_mask", heard)
        for name, leaf in leaves.items():
            observation.set(name, leaf)
        out.set("state", self._pilot.state())
        return out

    def _window(self, sensed: Sensed) -> TensorDict:
        """A window of steps [B, K], made once: building a TensorDict a step costs more."""
        shape = (*sensed.steps.shape, self.scenario.arena.n_uavs)
        static = {
            name: leaf.unsqueeze(1).expand(*shape, -1) for name, leaf in self.world.static.items()
        }
        observation = TensorDict({**sensed.leaves, **static}, shape, device=self.device)
        uav = TensorDict({"observation": observation, "mask": sensed.alive}, shape, self.device)
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
        )
