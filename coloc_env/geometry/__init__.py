"""Rotations and poses in the plane and in space; conventions in ``rotations`` and ``poses``."""

from coloc_env.geometry.pairs import pair_differences, pair_distances
from coloc_env.geometry.poses import Poses, Pulls
from coloc_env.geometry.rotations import (
    concat,
    cross,
    cross_matrix,
    join,
    level,
    plane_angle,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_log,
    quaternion_matrix,
    quaternion_product,
    rotate,
    rotate_by,
    rotation_between,
    rotation_matrix,
    unrotate,
    wrap_angle,
    yaw_quaternion,
)
from coloc_env.geometry.se2 import Se2
from coloc_env.geometry.se3 import Se3


def poses_in(dim: int) -> type[Poses]:
    """Poses in the plane or in space."""
    return Se3 if dim == 3 else Se2


__all__ = [
    "Poses",
    "Pulls",
    "Se2",
    "Se3",
    "concat",
    "cross",
    "cross_matrix",
    "join",
    "level",
    "pair_differences",
    "pair_distances",
    "plane_angle",
    "poses_in",
    "quaternion_conjugate",
    "quaternion_exp",
    "quaternion_log",
    "quaternion_matrix",
    "quaternion_product",
    "rotate",
    "rotate_by",
    "rotation_between",
    "rotation_matrix",
    "unrotate",
    "wrap_angle",
    "yaw_quaternion",
]
