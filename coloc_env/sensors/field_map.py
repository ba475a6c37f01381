"""A vector field at the nodes of a grid."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

MOST = 200_000  # nodes of a map

Grid = tuple[int, int, int]
Place = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class FieldMap:
    """``values`` (world frame) at ``count`` nodes along each axis, z fastest, ``spacing`` m apart
    from ``low`` (m) on; between them interpolated (trilinear), beyond them as at the edge.

    Raises:
        ValueError: more than 200 000 nodes, or not as many values.
    """

    low: Place
    count: Grid
    values: Float64[Tensor, "F 3"]
    spacing: Place = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        nodes = math.prod(self.count)
        if nodes > MOST:
            raise ValueError(f"a map of {nodes} nodes: at most {MOST} are allowed")
        if self.values.shape != (nodes, 3):
            raise ValueError(f"a map of {nodes} nodes has values {list(self.values.shape)}")

    def at(
        self, position: Float[Tensor, "*s 3"]
    ) -> tuple[Float[Tensor, "*s 3"], Float[Tensor, "*s 3 3"]]:
        """B (world frame) at positions (m), and ∂B/∂p."""
        shape, spacing = position.new_tensor(self.count), position.new_tensor(self.spacing)
        inside = (position - position.new_tensor(self.low)) / spacing
        at = inside.clamp_min(0.0).minimum(shape - 1)
        cell = at.floor().minimum(shape - 2).clamp_min(0.0)
        index = _corners(cell.to(torch.int64), self.count)
        values = self.values.to(position)[index].unflatten(-2, (2, 2, 2))
        share = (at - cell).unsqueeze(-1)  # [*s, 3, 1]
        x, y, z = (share[..., axis, :] for axis in range(3))
        along_z = torch.lerp(values[..., 0, :], values[..., 1, :], z[..., None, None, :])
        by_z = values[..., 1, :] - values[..., 0, :]  # [*s, 2, 2, 3]
        along_y = torch.lerp(along_z[..., 0, :], along_z[..., 1, :], y.unsqueeze(-2))
        by_y = along_z[..., 1, :] - along_z[..., 0, :]  # [*s, 2, 3]
        by_z = torch.lerp(by_z[..., 0, :], by_z[..., 1, :], y.unsqueeze(-2))
        value = torch.lerp(along_y[..., 0, :], along_y[..., 1, :], x)
        slopes = (
            along_y[..., 1, :] - along_y[..., 0, :],
            torch.lerp(by_y[..., 0, :], by_y[..., 1, :], x),
            torch.lerp(by_z[..., 0, :], by_z[..., 1, :], x),
        )
        within = (inside == at).to(position.dtype) / spacing
        return value, torch.stack(slopes, -1) * within.unsqueeze(-2)


def _corners(cell: Int64[Tensor, "*s 3"], count: Grid) -> Int64[Tensor, "*s 8"]:
    """Flat indices of the eight nodes of a cell, z fastest; a map one node thick repeats it."""
    steps = [torch.arange(2, device=cell.device).clamp_max(n - 1) for n in count]
    x, y, z = (cell[..., axis, None] + step for axis, step in enumerate(steps))
    plane = x.unsqueeze(-1) * count[1] + y.unsqueeze(-2)
    return (plane.unsqueeze(-1) * count[2] + z[..., None, None, :]).flatten(-3)
