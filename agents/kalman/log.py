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
        layout, found = Layout(self.believed.arena, self.believed.slots), {}
        for sensor in self.believed.sensors:
            found |= {name: leaf.width for name, leaf in sensor.leaves(layout).items()}
        return found | {"links": self.believed.slots}

    def empty(self, observation: Observation, steps: int) -> Float32[Tensor, "B N K F"]:
        """So many steps in which nothing was sensed."""
        row = self.row(observation)
        return row.new_zeros(*row.shape[:2], steps, row.shape[-1])

    def row(self, observation: Observation) -> Float32[Tensor, "B N F"]:
        """A step's leaves."""
        return torch.cat([observation[name] for name in self.widths], -1)

    def appended(
        self, log: Float32[Tensor, "B N K F"], observation: Observation
    ) -> Float32[Tensor, "B N K F"]:
        """The log with another step, without its oldest."""
        return torch.cat((log[..., 1:, :], self.row(observation).unsqueeze(-2)), -2)

    def leaves(self, row: Float32[Tensor, "*s F"]) -> dict[str, Float32[Tensor, "*s W"]]:
        """A step's leaves by name."""
        return dict(zip(self.widths, row.split(list(self.widths.values()), -1), strict=True))
