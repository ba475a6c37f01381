"""Odometry without attitude: how far a UAV moved over a step, in the world frame."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from coloc_env import noise
from coloc_env.sensors.base import Layout, Leaf, Sensor, Window, require


@dataclass(frozen=True)
class Displacement(Sensor):
    """Leaf ``displacement`` [d]: what the position changed by over the step that ends now (m, world
    frame); 0 at step 0.

    The noise has the variance ``still``² + ``moving``² · distance per axis and step, ``still`` in m
    and ``moving`` in m/√m. (A variance that grew with the speed's square would make slow flight
    free.) The last ``blind`` UAVs measure nothing, 0: their motion is known to be a random walk,
    N(0, ``walk``² I) m² a step.
    """

    may_be_blind = False

    still: float = 0.02
    moving: float = 0.1
    blind: int = 0
    walk: float = 1.0

    def __post_init__(self) -> None:
        for name in ("still", "moving", "walk"):
            require(0 <= getattr(self, name) < math.inf, self, name, "a size ≥ 0")
        require(self.blind >= 0, self, "blind", "a number of UAVs ≥ 0")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {"displacement": Leaf(layout.arena.dim, unit="m", frame="world")}

    def variance(self, distance: Float[Tensor, "*s N"]) -> Float[Tensor, "*s N"]:
        """Variance per axis (m²) of what is known of a step over some distance (m)."""
        variance = self.still**2 + self.moving**2 * distance
        if not self.blind:
            return variance
        index = torch.arange(distance.shape[-1], device=distance.device)
        return torch.where(index >= len(index) - self.blind, self.walk**2, variance)

    def distance(self, displacement: Float[Tensor, "*s d"]) -> Float[Tensor, "*s"]:
        """The distance D (m) at which E‖z‖² = D² + d (still² + moving² D) is what was measured."""
        d = displacement.shape[-1]
        half = 0.5 * d * self.moving**2
        squared = (displacement * displacement).sum(-1) - d * self.still**2
        return (half**2 + squared.clamp_min(0.0)).sqrt() - half

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        moved = window.motion.position - window.before.position
        squared = moved[..., 0] * moved[..., 0]
        for part in moved.unbind(-1)[1:]:
            squared = squared + part * part
        n, dim = moved.shape[-2:]
        white = noise.normal(window.keys, "displacement", n * dim).unflatten(-1, (n, dim))
        std = self.variance(squared.sqrt()).sqrt().to(torch.float32)
        measured = window.alive & (window.steps > 0).unsqueeze(-1)
        if self.blind:
            measured = measured & (torch.arange(n, device=white.device) < n - self.blind)
        sample = moved.to(torch.float32) + white * std.unsqueeze(-1)
        return {"displacement": sample * measured.unsqueeze(-1)}
