"""What SE(2) and SE(3) have in common, so that an estimator on poses is written once.

A pose is ``[position, attitude]`` in one vector, the attitude as in ``rotations``: ``[x, y, θ]`` in
the plane, ``[x, y, z, qw, qx, qy, qz]`` in space. It maps body to world. A tangent vector is
``[ρ, φ]``, **translation first** (as states are ordered; GTSAM has rotation first), and stands on
the right, in the body frame: ``x ⊞ ξ = x exp(ξ)``, ``y ⊟ x = log(x⁻¹ y)``. All is batched over
leading dimensions, which broadcast, in float32 or float64; gradients are those of the stored
numbers, finite at zero and at half turns.
"""

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from coloc_env.geometry.rotations import rotate


class Pulls(NamedTuple):
    """Sums over other poses of tangents that lead to them: of the tangents themselves, and of the
    squares of their position part (m²) and turn part (rad²)."""

    tangent: Float[Tensor, "*s m D"]
    position: Float[Tensor, "*s m"]
    turn: Float[Tensor, "*s m"]


class Poses(ABC):
    """A group of rigid motions: ``Se2`` or ``Se3``; no instances.

    ``dim``: of the space; ``dof``: of a tangent vector; ``size``: numbers stored for a pose.
    """

    dim: ClassVar[int]
    dof: ClassVar[int]
    size: ClassVar[int]

    @classmethod
    def split(cls, x: Float[Tensor, "*s P"]) -> tuple[Tensor, Tensor]:
        """Position (m) and attitude."""
        return x[..., : cls.dim], x[..., cls.dim :]

    @classmethod
    def identity(cls, like: Float[Tensor, "*s k"]) -> Float[Tensor, "P"]:
        """The pose at the origin, in the type and on the device of ``like``."""
        attitude = (1.0, 0.0, 0.0, 0.0) if cls.dim == 3 else (0.0,)
        return like.new_tensor((*(0.0,) * cls.dim, *attitude))

    @staticmethod
    @abstractmethod
    def quaternion(x: Float[Tensor, "*s P"]) -> Float[Tensor, "*s 4"]:
        """The attitude as a quaternion, in the plane too."""

    @staticmethod
    @abstractmethod
    def exp(xi: Float[Tensor, "*s D"]) -> Float[Tensor, "*s P"]:
        """Tangent vector to pose."""

    @staticmethod
    @abstractmethod
    def log(x: Float[Tensor, "*s P"]) -> Float[Tensor, "*s D"]:
        """Pose to the tangent vector of angle at most π."""

    @staticmethod
    @abstractmethod
    def compose(a: Float[Tensor, "*s P"], b: Float[Tensor, "*s P"]) -> Float[Tensor, "*s P"]:
        """``a b``: first ``b``, then ``a``."""

    @staticmethod
    @abstractmethod
    def between(a: Float[Tensor, "*s P"], b: Float[Tensor, "*s P"]) -> Float[Tensor, "*s P"]:
        """``a⁻¹ b``: the pose of ``b`` as seen from ``a``."""

    @classmethod
    def inverse(cls, x: Float[Tensor, "*s P"]) -> Float[Tensor, "*s P"]:
        """``x⁻¹``."""
        return cls.between(x, cls.identity(x))

    @classmethod
    def plus(cls, x: Float[Tensor, "*s P"], xi: Float[Tensor, "*s D"]) -> Float[Tensor, "*s P"]:
        """``x ⊞ ξ = x exp(ξ)``; what is stored of the attitude stays of unit length."""
        return cls.compose(x, cls.exp(xi))

    @classmethod
    def minus(cls, y: Float[Tensor, "*s P"], x: Float[Tensor, "*s P"]) -> Float[Tensor, "*s D"]:
        """``y ⊟ x = log(x⁻¹ y)``: the tangent at ``x`` that leads to ``y``."""
        return cls.log(cls.between(x, y))

    @classmethod
    def pulls(
        cls, x: Float[Tensor, "*s m P"], y: Float[Tensor, "*s n P"], weight: Float[Tensor, "*s n"]
    ) -> Pulls:
        """``Σ_n w_n (y_n ⊟ x_m)``, and the same sums of squares."""
        tangent = cls.minus(y.unsqueeze(-2), x.unsqueeze(-3))
        weight = weight[..., None, None]
        squares = weight * tangent.square()
        return Pulls(
            (weight * tangent).sum(-3),
            squares[..., : cls.dim].sum((-3, -1)),
            squares[..., cls.dim :].sum((-3, -1)),
        )

    @classmethod
    def act(cls, x: Float[Tensor, "*s P"], point: Float[Tensor, "*s d"]) -> Float[Tensor, "*s d"]:
        """A point (m) of the body frame in the world."""
        position, attitude = cls.split(x)
        return position + rotate(attitude, point)

    @staticmethod
    @abstractmethod
    def carry(x: Float[Tensor, "*s P"], xi: Float[Tensor, "*s D"]) -> Float[Tensor, "*s D"]:
        """``Ad(x) ξ``: ``x exp(ξ) = exp(Ad(x) ξ) x``."""

    @classmethod
    def adjoint(cls, x: Float[Tensor, "*s P"]) -> Float[Tensor, "*s D D"]:
        """The matrix ``Ad(x)``."""
        basis = torch.eye(cls.dof, dtype=x.dtype, device=x.device)
        return cls.carry(x.unsqueeze(-2), basis).mT

    @staticmethod
    @abstractmethod
    def right_jacobian(xi: Float[Tensor, "*s D"]) -> Float[Tensor, "*s D D"]:
        """``J_r(ξ)``: ``exp(ξ + δ) ≈ exp(ξ) exp(J_r(ξ) δ)``."""

    @staticmethod
    @abstractmethod
    def right_jacobian_inverse(xi: Float[Tensor, "*s D"]) -> Float[Tensor, "*s D D"]:
        """``J_r(ξ)⁻¹``, for angles below 2π."""
