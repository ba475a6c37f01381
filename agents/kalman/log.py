"""What was sensed lately, kept as numbers in a belief, to be used again or late."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float32
from torch import Tensor

from coloc_env.observation import Observation
from coloc_env.scenario import Believed
from coloc_env.sensors.base import Layout


@dataclass(frozen=True)
class SensedLog:
    """The leaves that a team's sensors deliver in a step, side by side, the newest step last."""

    believed: Believed

    @cached_property
    def widths(self) -> dict[str, int]:
        """Leaves and how many numbers each has."""
        layout = Layout(self.believed.arena, self.believed.slots)
        found: dict[str, int] = {}
        for sensor in self.believed.sensors:
            found |= {name: leaf.width for name, leaf in sensor.leaves(layout).items()}
        return found | {"links": self.believed.slots}

    def empty(self, observation: Observation, steps: int) -> Float32[Tensor, "B N K F"]:
        """So many steps in which nothing was sensed."""
        row = self.row(observation)
        return row.new_zeros(*row.shape[:2], steps, row.shape[-1])

    @cached_property
    def values(self) -> dict[str, str]:
        """The leaf of numbers that each mask is of."""
        masks = [name for name in self.widths if name.endswith("_mask")]
        stems = {mask: mask.removesuffix("_mask") for mask in masks}
        return {mask: stem if stem in self.widths else f"{stem}s" for mask, stem in stems.items()}

    def row(self, observation: Observation) -> Float32[Tensor, "B N F"]:
        """A step's leaves; 0 behind a mask."""
        leaves = {name: observation[name] for name in self.widths}
        for mask, value in self.values.items():
            there = (leaves[mask] > 0).unsqueeze(-1)
            parts = leaves[value].unflatten(-1, (there.shape[-2], -1))
            leaves[value] = torch.where(there, parts, 0.0).flatten(-2)
        return torch.cat(list(leaves.values()), -1)

    def appended(
        self, log: Float32[Tensor, "B N K F"], observation: Observation
    ) -> Float32[Tensor, "B N K F"]:
        """The log with another step, without its oldest."""
        return torch.cat((log[..., 1:, :], self.row(observation).unsqueeze(-2)), -2)

    def leaves(self, row: Float32[Tensor, "*s F"]) -> dict[str, Float32[Tensor, "*s W"]]:
        """A step's leaves by name."""
        return dict(zip(self.widths, row.split(list(self.widths.values()), -1), strict=True))
