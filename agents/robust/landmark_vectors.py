"""Ranges and bearings to landmarks as vectors: linear in the position, however broad the prior."""

import torch

from agents.models.measurements import Block


def as_vectors(block: Block) -> Block:
    """Vectors along and across the line of sight that was measured (converted measurements, Lerro &
    Bar-Shalom 1993), of ranges and bearings to landmarks.

    With the bearing's innovation β and the landmark at the distance D, h = D (cos β, −sin β), in
    place of (D, −β).
    """
    by_range, by_bearing = block.jacobian.unbind(-2)
    distance = torch.linalg.vector_norm(by_bearing[..., :2], dim=-1).reciprocal()
    measured = distance + block.residual[..., 0]
    sine, cosine = block.residual[..., 1].sin(), block.residual[..., 1].cos()
    s, c = sine.unsqueeze(-1), cosine.unsqueeze(-1)
    across = by_bearing * distance.unsqueeze(-1)
    rows = torch.stack((c * by_range + s * across, c * across - s * by_range), -2)
    variance = torch.stack((block.variance[..., 0], block.variance[..., 1] * measured**2), -1)
    return Block(
        residual=torch.stack((measured - distance * cosine, distance * sine), -1),
        jacobian=rows,
        variance=variance,
        mask=block.mask,
    )
