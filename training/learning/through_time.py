"""Backpropagation through a swarm localizer's steps: a batch that runs again, and its losses."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from agents.localizer import Estimate, Localizer
from agents.policies.adapters import LocalizerPolicy, flat, restored
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.observation import Observation, all_leaves
from coloc_env.scenario import Scenario
from training.learning.collectors import episode_collector

FAR = 3.0  # times the scale, beyond which a loss grows linearly
_SOFT = 20.0  # Mahalanobis² beyond which a lost UAV's loss grows like its logarithm only


def with_belief(
    variant: int, before: Any, after: Any, tensordict: TensorDictBase
) -> dict[str, Any]:
    """What a ``LocalizerPolicy`` is to record: the belief that a step starts from, and which
    variant it is of."""
    return {
        **flat(before),
        "variant": torch.full(before.batch_size[:1], variant, device=tensordict.device),
    }


def episodes(
    localizers: Sequence[Localizer[Any]],
    scenarios: Sequence[Scenario],
    worlds: int,
    steps: int,
    device: str,
    first: int,
    wrapped: Callable[[CoLocEnv, int], EnvBase] | None = None,
) -> list[Collector]:
    """Collectors of ``worlds`` worlds of each scenario, seeded from ``first`` on, in batches of
    ``steps`` steps that are recorded ``with_belief``; ``wrapped`` changes the i-th environment."""
    found = []
    for i, (localizer, one) in enumerate(zip(localizers, scenarios, strict=True)):
        env: Any = CoLocEnv(one, worlds, device, seed=first + i * worlds)
        policy = LocalizerPolicy(localizer, one, record=partial(with_belief, i))
        env = env if wrapped is None else wrapped(env, i)
        found.append(episode_collector(env, policy, steps, compact_obs=True))
    return found


def run_again(
    localizer: Localizer[Any], scenario: Scenario, batch: TensorDictBase
) -> Iterator[Estimate]:
    """The estimates of a batch [B, T] recorded ``with_belief``, from the belief that its first step
    started from and on the observations that were made, this time with gradients."""
    observed, belief = batch["uav", "observation"], None
    leaves = tuple(all_leaves(scenario))
    for t in range(batch.shape[1]):
        observation = Observation({name: observed[name][:, t] for name in leaves})
        if belief is None:
            begin = batch["train"].exclude("variant")[:, 0]
            belief = restored(localizer.reset(observation), begin, observation.batch_size)
        belief, estimate = localizer.step(belief, observation)
        yield estimate


def negative_log_likelihood(
    offset: Float[Tensor, "*s d"], covariance: Float[Tensor, "*s d d"]
) -> Float[Tensor, "*s"]:
    """½ (eᵀ P⁻¹ e + log det P) of a position's error, growing slowly where a UAV is lost."""
    root = torch.linalg.cholesky(covariance)
    scaled = torch.linalg.solve_triangular(root, offset.unsqueeze(-1), upper=False)[..., 0]
    squared = scaled.square().sum(-1)
    far = _SOFT * (1 + (squared.clamp_min(_SOFT) / _SOFT).log())
    squared = torch.where(squared > _SOFT, far, squared)
    return 0.5 * squared + root.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def masked_mean(values: Float[Tensor, "*s"], mask: Bool[Tensor, "*s"]) -> Float[Tensor, ""]:
    """Mean of the values where the mask is; 0 if it is nowhere."""
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp_min(1)


def far_off(squared: Float[Tensor, "*s"], scale: float = 1.0) -> Float[Tensor, "*s"]:
    """Pseudo-Huber: squared errors in units of ``scale``², growing linearly with the error far
    off."""
    return 2 * FAR**2 * ((1 + squared / (FAR * scale) ** 2).sqrt() - 1)


def cosine(first: float, last: float, share: float) -> float:
    """From ``first`` at share 0 to ``last`` at 1, along a cosine."""
    return last + (first - last) * (0.5 * (1 + math.cos(math.pi * share)))
