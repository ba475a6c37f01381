"""The flattened view: every UAV of every world a row of its own, as single-agent code wants it."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from coloc_env.envs.actions import chosen_leaves
from coloc_env.envs.torchrl import CoLocEnv


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
        self.worlds, self.n_uavs = env.batch_size[0], env.scenario.arena.n_uavs
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
                raise ValueError("the UAVs of a world start anew together, not one by one")
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
