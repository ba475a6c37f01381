"""Rays inside a room: how far it is to the first surface, and how that changes."""

import torch
from jaxtyping import Float
from torch import Tensor

from coloc_env.motion import Box

_FAR = 1e6  # m: of a surface that a ray runs along


def first_surface(
    origin: Float[Tensor, "*#s 3"],
    direction: Float[Tensor, "*#s 3"],
    room: Box,
    boxes: tuple[Box, ...] = (),
) -> tuple[Float[Tensor, "*s"], Float[Tensor, "*s 3"]]:
    """Distance t (m) from points inside a room along unit vectors b to its first surface, walls of
    the room and faces of ``boxes`` in it, and ∂t/∂p = −n / (n·b), n the normal there; ∂t/∂b is t
    times that. Slab method (Kay & Kajiya, SIGGRAPH 1986). From outside the room t is negative,
    as if its walls went on.
    """
    low, high = (origin.new_tensor(corner) for corner in room)
    leave = _rates(origin, direction, torch.where(direction > 0, high, low))
    distance, axis = leave.min(-1)
    for box in boxes:
        low, high = (origin.new_tensor(corner) for corner in box)
        near, far = torch.where(direction > 0, low, high), torch.where(direction > 0, high, low)
        into, side = _entry(origin, direction, near, low, high)
        out = _rates(origin, direction, far).amin(-1)
        hit = (into >= 0) & (into <= out) & (into < distance)
        distance, axis = torch.where(hit, into, distance), torch.where(hit, side, axis)
    there = torch.nn.functional.one_hot(axis, 3).to(direction.dtype)
    return distance, -there / torch.where(there > 0, direction, 1.0)


def corner_curvature(
    origin: Float[Tensor, "*#s 3"], direction: Float[Tensor, "*#s 3"], room: Box
) -> Float[Tensor, "*s"]:
    """What stands for a second derivative (1/m) of the distance to a room's walls, which is a
    minimum of linear functions: c such that ½ (c σ²)² is about the most that linearizing neglects
    of it for points that are uncertain by σ (m) an axis.

    If the next wall is g farther, and that gap changes by s = ‖∇g‖ σ, what is neglected is (e − g)₊
    with e ~ N(0, s²): of mean square s² ((1 + k²) Φ(−k) − k φ(k)), k = g / s (Clark 1961), which is
    at most 0.0757 s² / k²; and, as a distance t is hardly shortened by more than all of it,
    t² Φ(−k), at most 0.378 t² / k⁴.
    """
    low, high = (origin.new_tensor(corner) for corner in room)
    leave = _rates(origin, direction, torch.where(direction > 0, high, low))
    nearest, axes = leave.topk(2, -1, largest=False)
    first, second = nearest.unbind(-1)
    along = direction.expand_as(leave).gather(-1, axes).square()
    slope = torch.where(along > 1 / _FAR**2, 1 / along.clamp_min(1 / _FAR**2), 0.0).sum(-1)
    gap = (second - first).clamp_min(1e-6)
    by_corner = (2 * 0.0757) ** 0.5 * slope / gap
    by_all = (2 * 0.378) ** 0.5 * first.clamp_min(0.0) * slope / gap**2
    return torch.minimum(by_corner, by_all)


def _rates(
    origin: Float[Tensor, "*#s 3"], direction: Float[Tensor, "*#s 3"], plane: Float[Tensor, "*#s 3"]
) -> Float[Tensor, "*s 3"]:
    """Distance to the plane across each axis."""
    along = direction.abs() > 1 / _FAR
    return torch.where(along, (plane - origin) / torch.where(along, direction, 1.0), _FAR)


def _entry(
    origin: Float[Tensor, "*#s 3"],
    direction: Float[Tensor, "*#s 3"],
    near: Float[Tensor, "*#s 3"],
    low: Float[Tensor, "3"],
    high: Float[Tensor, "3"],
) -> tuple[Float[Tensor, "*s"], Tensor]:
    """Distance to where a ray is between all three pairs of a box's faces, and the axis of the last
    of these; a ray along an axis is between its faces everywhere or nowhere."""
    into = _rates(origin, direction, near)
    still = direction.abs() <= 1 / _FAR
    between = (origin >= low) & (origin <= high)
    into = torch.where(still, torch.where(between, -_FAR, 2 * _FAR), into)
    return into.max(-1).values, into.argmax(-1)
