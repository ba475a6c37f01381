"""Angles of arrival in space: in which direction of its body a UAV sees or hears another one."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import unrotate, wrap_angle
from coloc_env.options import Group, PositiveMetres, Quantity, Radians, Share
from coloc_env.sensors.base import (
    MASK,
    Layout,
    Leaf,
    Sensor,
    Window,
    in_slots,
    require,
    squared_norm,
)

_NEAR = 1e-12  # m²: of an azimuth that is none
Elevation = Annotated[float, Quantity("rad", above=0.0, below=math.pi / 2)]


def azimuth_elevation(v: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 2"]:
    """Azimuth (left of forward) and elevation (above the body's plane) in rad of a vector, body
    frame forward, left, up."""
    level = (v[..., 0] * v[..., 0] + v[..., 1] * v[..., 1]).sqrt()
    return torch.stack((torch.atan2(v[..., 1], v[..., 0]), torch.atan2(v[..., 2], level)), -1)


def angles_by_vector(v: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 2 3"]:
    """Derivatives of azimuth and elevation by the vector: (−y, x, 0) / ρ² and
    (−x z / ρ, −y z / ρ, ρ) / r², with ρ² = x² + y² and r² = ρ² + z²."""
    x, y, z = v.unbind(-1)
    level = (x * x + y * y).clamp_min(_NEAR)
    rho, squared = level.sqrt(), level + z * z
    azimuth = torch.stack((-y / level, x / level, torch.zeros_like(x)), -1)
    elevation = torch.stack((-x * z / rho, -y * z / rho, rho), -1) / squared.unsqueeze(-1)
    return torch.stack((azimuth, elevation), -2)


@dataclass(frozen=True)
class ArrivalAngles(Sensor):
    """Leaves ``arrival_angles`` [D · S · 2] and ``arrival_angle_mask`` [D · S]: azimuth and
    elevation in rad, body frame, of the UAV in each neighbour slot, with Gaussian noise
    ``azimuth_std`` and ``elevation_std``; each end measures for itself.

    An antenna array or camera that looks all around: nothing above or below ``field`` rad of
    elevation, where an azimuth says little, nor beyond ``radius`` m. A share ``dropout`` is
    missing. ``depth`` D: how many measurements of one UAV a step can deliver.
    """

    between_uavs = True

    azimuth_std: float = 0.05
    elevation_std: float = 0.05
    field: float = 1.2
    radius: float | None = None
    dropout: float = 0.0
    depth: int = 1

    def __post_init__(self) -> None:
        for name in ("azimuth_std", "elevation_std"):
            require(0 <= getattr(self, name) < math.inf, self, name, "a standard deviation in rad")
        require(0 < self.field < math.pi / 2, self, "field", "an elevation in (0, π/2) rad")
        require(self.radius is None or self.radius > 0, self, "radius", "a distance in m > 0")
        require(0 <= self.dropout <= 1, self, "dropout", "a probability in [0, 1]")
        require(self.depth >= 1, self, "depth", "at least one measurement")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        require(layout.arena.dim == 3, "ArrivalAngles", "dim", "elevations need a 3-D scenario")
        slots = self.depth * layout.slots
        return {
            "arrival_angles": Leaf(2 * slots, unit="rad", frame="body"),
            "arrival_angle_mask": Leaf(slots, *MASK),
        }

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        motion, n = window.motion, window.layout.arena.n_uavs
        theirs = in_slots(motion.position, window.neighbours)
        apart = unrotate(motion.attitude.unsqueeze(-2), theirs - motion.position.unsqueeze(-2))
        exact = azimuth_elevation(apart)  # [R, K, N, S, 2]
        seen = window.reach & (exact[..., 1].abs() <= self.field)
        if self.radius is not None:
            seen = seen & (squared_norm(apart) <= self.radius**2)
        seen, exact = seen.repeat(1, 1, 1, self.depth), exact.repeat(1, 1, 1, self.depth, 1)
        slots = seen.shape[-1]
        if self.dropout:
            drawn = noise.uniform(window.keys, "arrival_angles.dropout", n * slots)
            seen = seen & (drawn.unflatten(-1, (n, slots)) >= self.dropout)
        white = noise.normal(window.keys, "arrival_angles", 2 * n * slots)
        noisy = _noisy(exact, white.unflatten(-1, (n, slots, 2)), self)
        return {
            "arrival_angles": noisy.masked_fill_(~seen.unsqueeze(-1), 0.0).flatten(-2),
            "arrival_angle_mask": seen.to(torch.float32),
        }


def _noisy(
    exact: Float64[Tensor, "*s 2"], white: Float32[Tensor, "*s 2"], sensor: ArrivalAngles
) -> Float32[Tensor, "*s 2"]:
    std = white.new_tensor((sensor.azimuth_std, sensor.elevation_std))
    azimuth, elevation = (exact.to(torch.float32) + std * white).unbind(-1)
    return torch.stack((wrap_angle(azimuth), elevation), -1)


@dataclass(frozen=True)
class AngleOptions(Group):
    """With ``angles``, UAVs measure azimuth and elevation (body frame) of those within
    ``angle_radius`` m (none: of all in radio reach) and ``angle_field`` rad of elevation, with
    noise of ``azimuth_std`` and ``elevation_std`` rad; a share ``angle_dropout`` is missing.
    """

    title: ClassVar[str] = "angles of arrival"

    angles: bool = False
    azimuth_std: Radians = 0.05
    elevation_std: Radians = 0.05
    angle_field: Elevation = 1.2
    angle_radius: PositiveMetres | None = None
    angle_dropout: Share = 0.0

    @property
    def true(self) -> tuple[ArrivalAngles, ...]:
        """The sensor as it is; nothing without angles."""
        own = (self.azimuth_std, self.elevation_std, self.angle_field, self.angle_radius)
        return (ArrivalAngles(*own, self.angle_dropout),) if self.angles else ()
