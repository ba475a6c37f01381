"""Distances to the nearest walls along the body's axes, by ultrasound."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import cross_matrix, rotation_matrix
from coloc_env.geometry.rays import corner_curvature, first_surface
from coloc_env.motion import Box
from coloc_env.options import Group, Metres, PositiveMetres, Share
from coloc_env.sensors.base import MASK, Layout, Leaf, Sensor, Window, require

BEAMS = (  # forward, back, left, right, up, down: body frame
    (1.0, 0.0, 0.0),
    (-1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, -1.0, 0.0),
    (0.0, 0.0, 1.0),
    (0.0, 0.0, -1.0),
)


@dataclass(frozen=True)
class Ultrasonic(Sensor):
    """Leaves ``ultrasonic`` [6] and ``ultrasonic_mask`` [6]: distance in m to the first surface
    forward, back, left, right, up and down (body frame), with Gaussian noise ``std``; no echo from
    beyond ``reach`` m, and a share ``dropout`` is missing.

    Surfaces are the walls, floor and ceiling of the ``room`` (low and high corner, m), and what
    ``walls`` stand in it.
    """

    room: Box
    std: float = 0.03
    reach: float = 4.0
    dropout: float = 0.05
    walls: tuple[Box, ...] = ()

    def __post_init__(self) -> None:
        require(len(self.room[0]) == 3, self, "room", "corners of three numbers")
        require(0 <= self.std < math.inf, self, "std", "a standard deviation in m ≥ 0")
        require(self.reach > 0, self, "reach", "a distance in m > 0")
        require(0 <= self.dropout <= 1, self, "dropout", "a probability in [0, 1]")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        require(layout.arena.dim == 3, "Ultrasonic", "dim", "six beams need a 3-D scenario")
        return {
            "ultrasonic": Leaf(len(BEAMS), unit="m", frame="body"),
            "ultrasonic_mask": Leaf(len(BEAMS), *MASK),
        }

    def expected(
        self, position: Float[Tensor, "*s 3"], rotation: Float[Tensor, "*s 3 3"]
    ) -> tuple[Float[Tensor, "*s 6"], Float[Tensor, "*s 6 6"]]:
        """Distances (m), and their derivatives by δp (world) and δθ (right): beams are b = R e, by
        which t changes as t ∂t/∂p, and b as −R [e]× δθ."""
        axes = rotation.new_tensor(BEAMS)
        beams = axes @ rotation.mT  # b = R e
        distance, by_place = first_surface(position.unsqueeze(-2), beams, self.room, self.walls)
        by_beam = distance.unsqueeze(-1) * by_place
        turned = -rotation.unsqueeze(-3) @ cross_matrix(axes)
        by_turn = (by_beam.unsqueeze(-2) @ turned)[..., 0, :]
        return distance, torch.cat((by_place, by_turn), -1)

    def curvature(
        self, position: Float[Tensor, "*s 3"], rotation: Float[Tensor, "*s 3 3"]
    ) -> Float[Tensor, "*s 6"]:
        """What stands for second derivatives (1/m) where beams go from one wall to the next."""
        beams = rotation.new_tensor(BEAMS) @ rotation.mT
        return corner_curvature(position.unsqueeze(-2), beams, self.room)

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        motion = window.motion
        distance, _ = self.expected(motion.position, rotation_matrix(motion.attitude))
        shape = distance.shape[-2:]
        count = shape[0] * shape[1]
        seen = window.alive.unsqueeze(-1) & (distance <= self.reach)
        if self.dropout:
            drawn = noise.uniform(window.keys, "ultrasonic.dropout", count)
            seen = seen & (drawn.unflatten(-1, shape) >= self.dropout)
        white = noise.normal(window.keys, "ultrasonic", count).unflatten(-1, shape)
        mask = seen.to(torch.float32)
        return {
            "ultrasonic": (distance.to(torch.float32) + self.std * white) * mask,
            "ultrasonic_mask": mask,
        }


@dataclass(frozen=True)
class UltrasonicOptions(Group):
    """With ``ultrasonic``, UAVs measure the distance to the nearest wall (floor and ceiling
    included) forward, back, left, right, up and down (body frame), as far as ``ultrasonic_reach``
    m, with noise of ``ultrasonic_std`` m; a share ``ultrasonic_dropout`` is missing."""

    title: ClassVar[str] = "ultrasound"

    ultrasonic: bool = False
    ultrasonic_std: Metres = 0.03
    ultrasonic_reach: PositiveMetres = 4.0
    ultrasonic_dropout: Share = 0.05

    def true(self, room: tuple[float, ...], walls: tuple[Box, ...] = ()) -> tuple[Ultrasonic, ...]:
        """The sensor as it is, in a room with sides in m with walls in it; nothing without
        ultrasound."""
        own = (self.ultrasonic_std, self.ultrasonic_reach, self.ultrasonic_dropout, walls)
        return (Ultrasonic(((0.0,) * 3, room), *own),) if self.ultrasonic else ()
