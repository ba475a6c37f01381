"""Localization in the loop of TorchRL's multi-agent environments."""

from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import Transform

from agents.wrappers.adapter import Adapter, NoiseSeeds
from agents.wrappers.entries import replaced
from agents.wrappers.localization import Localization


class LocalizedTransform(Transform):
    """``TransformedEnv(env, LocalizedTransform(task))``: agents see what a localizer knows; as
    ``agents.wrappers.Localized``, for any environment of B worlds (or none) whose agents' flat
    observations [B, N, F] lie at ``key``.

    ``task.positions`` and ``task.entries`` are given the environment that is wrapped. Seeds of the
    noise follow the environment's ``set_seed``. Beside the observations, under ``info``, is each
    agent's ``localization_error`` [B, N, 1] in m.
    """

    def __init__(
        self,
        task: Adapter,
        localizer: str = "ekf",
        key: NestedKey = ("agents", "observation"),
        **overrides: Any,
    ) -> None:
        beside = () if isinstance(key, str) else key[:-1]
        super().__init__(in_keys=[key], out_keys=[key, (*beside, "info", "localization_error")])
        self.task, self._localizer, self._overrides = task, localizer, overrides
        self.team: Localization | None = None
        self._seeds = NoiseSeeds()

    def set_seed(self, seed: int) -> None:
        """Of the noise to come."""
        self._seeds.next = seed

    def _reset(
        self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        places = self.task.places(self.parent.base_env)
        if self.team is None:
            self.team = self.task.localization(self._localizer, places, **self._overrides)
        asked = None if tensordict is None else tensordict.get("_reset", None)
        rows = None if asked is None else asked.reshape(len(places), -1).any(-1).cpu()
        self.team.restart(places, self._seeds.take(len(places)), rows)
        return self._known(tensordict_reset, places)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        assert self.team is not None
        places = self.task.places(self.parent.base_env)
        self.team.move(places)
        return self._known(next_tensordict, places)

    def _known(self, tensordict: TensorDictBase, places: Tensor) -> TensorDictBase:
        assert self.team is not None
        env, key = self.parent.base_env, self.in_keys[0]
        seen = tensordict[key]
        if seen.shape[-2:-1] != places.shape[1:2]:
            raise ValueError(
                f"Localized: {key} of shape {tuple(seen.shape)} does not fit: (…, "
                f"{places.shape[1]} agents, numbers) is needed"
            )
        rows = seen.reshape(len(places), *seen.shape[-2:]).cpu().unbind(1)
        known = [
            replaced(row, self.task.entries(env, i), places, self.team, i, env)
            for i, row in enumerate(rows)
        ]
        tensordict.set(key, torch.stack(known, 1).reshape(seen.shape).to(seen))
        error = self.team.error.reshape(*seen.shape[:-1], 1)
        return tensordict.set(self.out_keys[1], error.to(seen.device))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Estimates have no bounds."""
        key, error = self.out_keys
        old = observation_spec[key]
        observation_spec[key] = Unbounded(shape=old.shape, dtype=old.dtype, device=old.device)
        shape = (*old.shape[:-1], 1)
        observation_spec[error] = Unbounded(shape=shape, device=old.device)
        return observation_spec
