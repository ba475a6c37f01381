"""What a team spends: how far it moves, the energy for it, and how often UAVs come too close."""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from coloc_env.world import World

# Zeng, Xu and Zhang, "Energy Minimization for Wireless Communication With Rotary-Wing UAV", IEEE
# TWC 18(4), 2019, table I: a quadrotor of 20 N.
_BLADE, _INDUCED = 79.8563, 88.6279  # W, hovering: blade profile and induced power
_TIP = 120.0  # m/s: of the rotor blades
_INFLOW = 4.03  # m/s: mean induced velocity, hovering
_PARASITE = 0.5 * 0.6 * 1.225 * 0.05 * 0.503  # kg/m: ½ d₀ ρ s A


def rotor_power(speed: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """Power (W) of a quadrotor in level flight at a speed (m/s), by equation 12 of that paper:

    P = P₀ (1 + 3 V²/U²) + P₁ (√(1 + V⁴/4v₀⁴) − V²/2v₀²)^½ + ½ d₀ ρ s A V³.
    """
    squared = speed**2
    ratio = squared / (2 * _INFLOW**2)
    induced = _INDUCED * ((1 + ratio**2).sqrt() - ratio).sqrt()
    return _BLADE * (1 + 3 * squared / _TIP**2) + induced + _PARASITE * squared * speed


class Effort:
    """What each UAV of a world's rows has spent since this was made, [B, N] each: ``distance`` (m),
    ``energy`` (J), and ``collisions``, steps at which another UAV is closer than ``apart`` m.

    Call ``count()`` after every step of the world. Rows that are reset go on counting.
    """

    def __init__(self, world: World, apart: float = 1.0) -> None:
        self.world, self.apart = world, apart
        shape = (world.batch_size, world.scenario.arena.n_uavs)
        self.distance, self.energy = torch.zeros(2, *shape, dtype=torch.float64)
        self.collisions = torch.zeros(shape, dtype=torch.int64)
        self._before: Float64[Tensor, "B N d"] = world.truth.position

    def count(self) -> None:
        """Add the step that led to the world's present."""
        now, dt = self.world.truth.position, self.world.scenario.arena.dt
        moved = (now - self._before).norm(dim=-1)
        self.distance = self.distance + moved
        self.energy = self.energy + dt * rotor_power(moved / dt)
        apart = torch.cdist(now, now)
        apart.diagonal(dim1=1, dim2=2).fill_(torch.inf)
        alive = self.world.alive
        near = (apart < self.apart) & alive.unsqueeze(1) & alive.unsqueeze(2)
        self.collisions = self.collisions + near.any(-1)
        self._before = now
