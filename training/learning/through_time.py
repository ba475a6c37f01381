"""Backpropagation through a swarm localizer's steps: a batch that runs again, and its losses."""

import math
from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDictBase
from torch import Tensor

from agents.localizer import Estimate, Localizer
from agents.policies.adapters import flat, restored
from coloc_env.observation import Observation, all_leaves
from coloc_env.scenario import Scenario

FAR = 3.0  # times the scale, beyond which a loss grows linearly


def with_belief(
    variant: int, before: Any, after: Any, tensordict: TensorDictBase
) -> dict[str, Any]:
    """What a ``LocalizerPolicy`` is to record: the belief that a step starts from, and which
    variant it is of."""
    return {
        **flat(before),
        "variant": torch.full(before.batch_size[:1], variant, device=tensordict.device),
    }


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
