"""Frames that recordings are made in, turned into ours: east-north-up, bodies forward-left-up.

In ``ned`` the world is north-east-down and bodies are forward-right-down.
"""

import numpy as np

from coloc_env.datasets.recording import Floats


def world(points: Floats, frame: str) -> Floats:
    """Vectors [..., d] of the recorded world in ours."""
    if frame != "ned":
        return points
    if points.shape[-1] == 2:
        return points[..., ::-1].copy()
    return np.stack((points[..., 1], points[..., 0], -points[..., 2]), -1)


def body(vectors: Floats, frame: str) -> Floats:
    """Vectors [..., d] in the recorded body frame in ours."""
    if frame != "ned":
        return vectors
    return vectors * np.array((1.0, -1.0, -1.0))[: vectors.shape[-1]]


def heading(angle: Floats, frame: str) -> Floats:
    """Headings: from north, clockwise, to from east, counter-clockwise."""
    return np.pi / 2 - angle if frame == "ned" else angle


def turn(angle: Floats, frame: str) -> Floats:
    """Angles and rates about the vertical, and bearings: clockwise to counter-clockwise."""
    return -angle if frame == "ned" else angle


def attitude(quaternion: Floats, frame: str) -> Floats:
    """Quaternions [..., 4] wxyz, body to world.

    q' = t ⊗ q ⊗ (0, 1, 0, 0): half a turn about x takes FLU to FRD, t = (0, 1, 1, 0)/√2 NED to ENU.
    """
    if frame != "ned":
        return quaternion
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    # q ⊗ i, then t ⊗ that
    a, b, c, d = -x, w, z, -y
    root = np.sqrt(0.5)
    return np.stack((-b - c, a + d, a - d, c - b), -1) * root
