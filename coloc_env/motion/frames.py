"""Attitudes of a vehicle on a known path, from unit directions rather than from angles.

Elementwise only, and no ``atan2``: its vector and scalar versions differ in the last bit, so a row
would depend on the size of its batch.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float64
from torch import Tensor

from coloc_env.geometry import quaternion_product
from coloc_env.motion.base import Kinematics

GRAVITY = 9.81
_NO_DIRECTION = 1e-18  # below this squared length (m²) a vector has no direction


def unit(
    x: Float64[Tensor, "*s"], y: Float64[Tensor, "*s"]
) -> tuple[Float64[Tensor, "*s"], Float64[Tensor, "*s"]]:
    """The direction of a horizontal vector; that of the x axis for a vector of no length."""
    squared = x * x + y * y
    directed = squared > _NO_DIRECTION
    length = torch.where(directed, squared, 1.0).sqrt()
    return torch.where(directed, x / length, 1.0), torch.where(directed, y / length, 0.0)


def heading(cosine: Float64[Tensor, "*s"], sine: Float64[Tensor, "*s"]) -> Float64[Tensor, "*s"]:
    """The angle of a unit vector in [-π, π], by half angles: tan ψ/2 = sin ψ / (1 + cos ψ)."""
    return 2 * torch.where(cosine >= 0, sine / (1 + cosine), (1 - cosine) / sine).atan()


def yaw_attitude(
    cosine: Float64[Tensor, "*s"], sine: Float64[Tensor, "*s"], dim: int
) -> Float64[Tensor, "*s a"]:
    """Level attitude whose x axis points along the unit vector ``(cosine, sine)``.

    A quaternion with w ≥ 0 (dim = 3) or a heading in [-π, π] (dim = 2).
    """
    if dim == 2:
        return heading(cosine, sine).unsqueeze(-1)
    larger = (0.5 * cosine.abs() + 0.5).sqrt()
    smaller = 0.5 * sine / larger
    forward = cosine >= 0
    w = torch.where(forward, larger, smaller.abs())
    z = torch.where(forward, smaller, torch.copysign(larger, sine))
    return columns((w, 0.0, 0.0, z), w)


def columns(components: Sequence[Tensor | float], like: Float64[Tensor, "*s"]) -> Tensor:
    """Vectors from their components, each broadcast to ``like``; faster than ``torch.stack``."""
    vectors = like.new_empty((*like.shape, len(components)))
    for axis, component in enumerate(components):
        vectors[..., axis] = component
    return vectors


def level_flight(
    position: Sequence[Tensor | float],
    velocity: Sequence[Tensor | float],
    ahead: tuple[Float64[Tensor, "R K N"], Float64[Tensor, "R K N"]],
    dim: int,
) -> Kinematics:
    """Kinematics from components, level, with the x axis along the unit vector ``ahead``.

    ``ahead`` gives the shape; components may be smaller tensors or plain numbers, and those beyond
    ``dim`` are left out.
    """
    like = ahead[0]
    return Kinematics(
        columns(position[:dim], like), columns(velocity[:dim], like), yaw_attitude(*ahead, dim)
    )


def thrust_attitude(
    acceleration: Float64[Tensor, "*s 3"],
    cosine: Float64[Tensor, "*s"],
    sine: Float64[Tensor, "*s"],
) -> Float64[Tensor, "*s 4"]:
    """Attitude of a multirotor: z axis along its specific force a − g, x axis towards a heading.

    Differential flatness (Mellinger & Kumar, ICRA 2011): the x axis is the heading vector
    ``(cosine, sine, 0)`` made orthogonal to the z axis. Needs a vertical acceleration above −9.81.
    The quaternion is a yaw followed by the shortest rotation that takes the vertical to the z axis.
    """
    fx, fy, fz = acceleration.unbind(-1)
    fz = fz + GRAVITY
    force = (fx * fx + fy * fy + fz * fz).sqrt()
    zx, zy, zz = fx / force, fy / force, fz / force
    w = (0.5 * zz + 0.5).sqrt()
    tilt = columns((w, -0.5 * zy / w, 0.5 * zx / w, 0.0), w)
    along = (zx * cosine + zy * sine) / (1 + zz)
    yaw = yaw_attitude(*unit(cosine - along * zx, sine - along * zy), 3)
    attitude = quaternion_product(tilt, yaw)
    return torch.where(attitude[..., :1] < 0, -attitude, attitude)
