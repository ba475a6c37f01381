"""Decisions among a few moves, where a task's actions are velocities."""

import torch
from jaxtyping import Float32
from torch import Tensor

_DIAGONAL = 0.5**0.5
MOVES: dict[str, tuple[tuple[float, float], ...]] = {
    "corridor": ((0.0, 0.0), (1.0, 0.0), (_DIAGONAL, _DIAGONAL), (_DIAGONAL, -_DIAGONAL), (0.4, 0)),
    "headings": (
        (0.0, 0.0),
        *((1.0, 0.0), (_DIAGONAL, _DIAGONAL), (0.0, 1.0), (-_DIAGONAL, _DIAGONAL)),
        *((-1.0, 0.0), (-_DIAGONAL, -_DIAGONAL), (0.0, -1.0), (_DIAGONAL, -_DIAGONAL)),
    ),
}


def table(moves: str, dim: int) -> Float32[Tensor, "C d"]:
    """Velocities (units of the top speed) of a menu's moves: ``corridor``: stop, on, on and to
    either side, slowly on; ``headings``: stop, eight headings. In 3-D they are level, and up and
    down come last."""
    level = torch.tensor(MOVES[moves], dtype=torch.float32)
    if dim == 2:
        return level
    level = torch.cat((level, torch.zeros(len(level), 1)), 1)
    return torch.cat((level, torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])))
