"""Heading, from a compass."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import cross_matrix, rotation_matrix, wrap_angle
from coloc_env.options import Group, Radians, Share
from coloc_env.sensors.base import MASK, Layout, Leaf, Sensor, Window, require

_LEVEL = 1e-6  # squared length of the level part of the forward axis that has no heading


def heading(
    rotation: Float[Tensor, "*s d d"],
) -> tuple[Float[Tensor, "*s"], Float[Tensor, "*s t"]]:
    """ψ = atan2(f_y, f_x) in rad of the body's forward axis f = R e_x, and its derivative by the
    attitude error δθ (right: R exp(δθ)), by which f changes as −R [e_x]× δθ."""
    forward = rotation[..., 0]
    x, y = forward[..., 0], forward[..., 1]
    if rotation.shape[-1] == 2:
        return torch.atan2(y, x), torch.ones_like(rotation[..., 0, :1])
    turned = -rotation @ cross_matrix(rotation.new_tensor((1.0, 0.0, 0.0)))
    level = (x * x + y * y).clamp_min(_LEVEL).unsqueeze(-1)
    by_turn = (x.unsqueeze(-1) * turned[..., 1, :] - y.unsqueeze(-1) * turned[..., 0, :]) / level
    return torch.atan2(y, x), by_turn


@dataclass(frozen=True)
class Compass(Sensor):
    """Leaves ``compass`` [1] and ``compass_mask`` [1]: heading of the body's forward axis in rad,
    from the world's x axis, counter-clockwise, with Gaussian noise ``std``. A share ``dropout`` is
    missing."""

    std: float = 0.1
    dropout: float = 0.0

    def __post_init__(self) -> None:
        require(0 <= self.std < math.inf, self, "std", "a standard deviation in rad ≥ 0")
        require(0 <= self.dropout <= 1, self, "dropout", "a probability in [0, 1]")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {"compass": Leaf(1, unit="rad", frame="world"), "compass_mask": Leaf(1, *MASK)}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        true, _ = heading(rotation_matrix(window.motion.attitude))
        n, seen = true.shape[-1], window.alive
        if self.dropout:
            seen = seen & (noise.uniform(window.keys, "compass.dropout", n) >= self.dropout)
        noisy = true.to(torch.float32) + self.std * noise.normal(window.keys, "compass", n)
        mask = seen.to(torch.float32)
        return {
            "compass": (wrap_angle(noisy) * mask).unsqueeze(-1),
            "compass_mask": mask.unsqueeze(-1),
        }


@dataclass(frozen=True)
class CompassOptions(Group):
    """With ``compass``, UAVs measure their heading with noise of ``compass_std`` rad; a share
    ``compass_dropout`` is missing."""

    title: ClassVar[str] = "compass"

    compass: bool = False
    compass_std: Radians = 0.1
    compass_dropout: Share = 0.0

    @property
    def true(self) -> tuple[Compass, ...]:
        """The sensor as it is; nothing without a compass."""
        return (Compass(self.compass_std, self.compass_dropout),) if self.compass else ()
