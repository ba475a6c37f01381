"""A localizer of one's own, as simple as can be: the nearest anchors' mean."""

from typing import Any

import torch
from tensordict import TensorClass
from torch import Tensor

from agents import Estimate, Localizer
from coloc_env.observation import Observation
from coloc_env.options import PositiveCount
from coloc_env.scenario import Believed
from coloc_env.sensors import AnchorRanging


class Nothing(TensorClass):
    """A belief that holds nothing but the step; batch (B, N)."""

    step: Tensor


class AnchorMean(Localizer[Any]):
    """The mean of the nearest anchors, weighted by inverse distance."""

    name = "anchor_mean"
    serves = (AnchorRanging,)

    def __init__(self, believed: Believed, *, nearest: PositiveCount = 3) -> None:
        super().__init__(believed)
        self.nearest = nearest

    def reset(self, observation: Observation) -> Nothing:
        step = torch.zeros_like(observation["prior"][..., 0])
        return Nothing(step=step, batch_size=step.shape)

    def step(self, belief: Nothing, observation: Observation) -> tuple[Nothing, Estimate]:
        ranges, mask = observation["anchor_ranges"], observation["anchor_range_mask"]
        anchors = observation["anchor_map"].unflatten(-1, (-1, self.believed.arena.dim))
        weight = mask / ranges.clamp_min(0.1)
        count = min(self.nearest, weight.shape[-1])
        weight = weight * (weight >= weight.topk(count, -1).values[..., -1:])
        share = weight / weight.sum(-1, keepdim=True).clamp_min(1e-9)
        position = (share.unsqueeze(-1) * anchors).sum(-2)
        covariance = 4.0 * torch.eye(position.shape[-1]).expand(*position.shape, -1)
        estimate = Estimate(
            position=position,
            velocity=torch.zeros_like(position),
            covariance=covariance,
            batch_size=belief.batch_size,
        )
        return Nothing(step=belief.step + 1, batch_size=belief.batch_size), estimate
