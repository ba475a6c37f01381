"""Geometry of what is drawn: views of the arena, markers, ellipses, boxes, round numbers."""

import math
from dataclasses import dataclass

import numpy as np

from coloc_env.motion import Arena

WIDTH, HEIGHT, DPI = 1200, 750, 100  # of the picture, px
_AZIMUTH, _ELEVATION = math.radians(-62.0), math.radians(33.0)
_LEAST_HEIGHT = 0.11  # of the arena's longer side: flatter arenas are drawn taller

BOX_EDGES = np.array(
    [(i, i | 1 << axis) for axis in range(3) for i in range(8) if not i >> axis & 1]
)
BOX_FACES = np.array(
    [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
)


@dataclass(frozen=True)
class View:
    """A parallel projection: points [..., d] in m to the picture's plane [..., 2] in m.

    ``stretch``: by how much heights are exaggerated.
    """

    matrix: np.ndarray
    stretch: float = 1.0

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return points @ self.matrix.T

    def angle(self, directions: np.ndarray) -> np.ndarray:
        """Angles [N] (rad) in the plane of directions [N, d]."""
        flat = self(directions)
        return np.arctan2(flat[..., 1], flat[..., 0])


def plan(dim: int) -> View:
    """From above: x to the right, y up."""
    return View(np.eye(2, dim))


def tilted(arena: Arena) -> View:
    """From in front and above; the heights of a flat arena are exaggerated by a round factor."""
    x, y, z = (b - a for a, b in zip(arena.low, arena.high, strict=True))
    stretch = max(1.0, nice(_LEAST_HEIGHT * max(x, y) / z))
    ca, sa, ce, se = (f(a) for a in (_AZIMUTH, _ELEVATION) for f in (math.cos, math.sin))
    return View(np.array([(-sa, ca, 0.0), (-se * ca, -se * sa, ce * stretch)]), stretch)


def nice(value: float) -> float:
    """The smallest of …, 0.5, 1, 2, 5, 10, … that is at least ``value`` > 0."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= value * (1 - 1e-9))


def corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The corners [8, 3] of a box; bit ``a`` of a corner's index is which end of axis ``a``."""
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    return np.where(bits, high, low)


def disc(points: int = 36) -> np.ndarray:
    """A closed unit circle [points, 2]."""
    angle = np.linspace(0.0, 2 * np.pi, points)
    return np.stack((np.cos(angle), np.sin(angle)), -1)


def drop(tip: float) -> np.ndarray:
    """A unit disc [P, 2] drawn out to a nose at (``tip``, 0), ``tip`` > 1."""
    touch = math.acos(1 / tip)
    angle = np.linspace(touch, 2 * np.pi - touch, 24)
    arc = np.stack((np.cos(angle), np.sin(angle)), -1)
    return np.concatenate(([(tip, 0.0)], arc, [(tip, 0.0)]))


def placed(shape: np.ndarray, at: np.ndarray, angle: np.ndarray, size: float) -> np.ndarray:
    """A shape [P, 2] turned by ``angle`` [N] (rad), scaled, moved to ``at`` [N, 2]: [N, P, 2]."""
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.stack((cosine, -sine, sine, cosine), -1).reshape(-1, 2, 2)
    return at[:, None] + size * np.einsum("nij,pj->npi", turn, shape)


def ellipses(view: View, centre: np.ndarray, std: np.ndarray, scale: float) -> np.ndarray:
    """Outlines [N, P, 2] in the view of ellipsoids about ``centre`` [N, d] with half axes
    ``scale · std`` [N, d] along the world's axes."""
    spread = np.einsum("ia,na,ja->nij", view.matrix, (scale * std) ** 2, view.matrix)
    first = np.sqrt(spread[:, 0, 0])
    slant = spread[:, 0, 1] / np.maximum(first, 1e-12)
    second = np.sqrt(np.maximum(spread[:, 1, 1] - slant**2, 0.0))
    cosine, sine = disc().T
    outline = np.stack(
        (first[:, None] * cosine, slant[:, None] * cosine + second[:, None] * sine), -1
    )
    return view(centre)[:, None] + outline


def metres(value: float) -> str:
    """A length in words: ``0.2 m``, ``30 m``, ``10 km``."""
    return f"{value / 1000:g} km" if value >= 1000 else f"{value:g} m"
