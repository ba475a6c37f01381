"""SE(3): poses in space, ``[x, y, z, qw, qx, qy, qz]`` (Barfoot 2017, section 7.1)."""

import torch
from jaxtyping import Float
from torch import Tensor

from coloc_env.geometry import so3
from coloc_env.geometry.coefficients import inverse_coefficient, stumpff
from coloc_env.geometry.poses import Poses
from coloc_env.geometry.rotations import (
    concat,
    cross,
    cross_matrix,
    join,
    quaternion_conjugate,
    quaternion_log,
    quaternion_product,
    rotate,
    unrotate,
)


class Se3(Poses):
    """Poses in space; of a quaternion's two signs either may be stored."""

    dim, dof, size = 3, 6, 7

    @staticmethod
    def quaternion(x: Float[Tensor, "*s 7"]) -> Float[Tensor, "*s 4"]:
        """The attitude as a quaternion."""
        return x[..., 3:]

    @staticmethod
    def exp(xi: Float[Tensor, "*s 6"]) -> Float[Tensor, "*s 7"]:
        """Tangent vector to pose: the position is ``c₁ ρ + c₂ φ × ρ + c₃ (φ·ρ) φ``."""
        u, v, w, x, y, z = xi.unbind(-1)
        squared = x * x + y * y + z * z
        (third,) = stumpff(squared, (3,))
        first = 1 - squared * third
        angle = (squared + torch.finfo(xi.dtype).tiny).sqrt()
        half = 0.5 * angle
        sine = half.sin() / angle
        second = 2 * sine * sine
        along = third * (x * u + y * v + z * w)
        return join(
            (
                first * u + second * (y * w - z * v) + along * x,
                first * v + second * (z * u - x * w) + along * y,
                first * w + second * (x * v - y * u) + along * z,
                half.cos(),
                sine * x,
                sine * y,
                sine * z,
            )
        )

    @staticmethod
    def log(x: Float[Tensor, "*s 7"]) -> Float[Tensor, "*s 6"]:
        """Pose to the tangent vector of angle at most π: with ``c`` the coefficient of the inverse
        Jacobian, ρ is ``(1 − c θ²) t − ½ φ × t + c (φ·t) φ``."""
        half = 0.5 * quaternion_log(x[..., 3:])
        (px, py, pz), (a, b, c) = x[..., :3].unbind(-1), half.unbind(-1)
        squared = 4 * (a * a + b * b + c * c)
        quadratic = inverse_coefficient(squared)
        across = 1 - squared * quadratic
        along = 4 * quadratic * (a * px + b * py + c * pz)
        return join(
            (
                across * px - (b * pz - c * py) + along * a,
                across * py - (c * px - a * pz) + along * b,
                across * pz - (a * py - b * px) + along * c,
                2 * a,
                2 * b,
                2 * c,
            )
        )

    @staticmethod
    def compose(a: Float[Tensor, "*s 7"], b: Float[Tensor, "*s 7"]) -> Float[Tensor, "*s 7"]:
        """``a b``: first ``b``, then ``a``; the quaternion is made of unit length again."""
        attitude = quaternion_product(a[..., 3:], b[..., 3:])
        w, x, y, z = attitude.unbind(-1)
        length = (w * w + x * x + y * y + z * z).sqrt().unsqueeze(-1)
        return concat((a[..., :3] + rotate(a[..., 3:], b[..., :3]), attitude / length))

    @staticmethod
    def between(a: Float[Tensor, "*s 7"], b: Float[Tensor, "*s 7"]) -> Float[Tensor, "*s 7"]:
        """``a⁻¹ b``: the pose of ``b`` as seen from ``a``."""
        position = unrotate(a[..., 3:], b[..., :3] - a[..., :3])
        turn = quaternion_product(quaternion_conjugate(a[..., 3:]), b[..., 3:])
        return concat((position, turn))

    @staticmethod
    def carry(x: Float[Tensor, "*s 7"], xi: Float[Tensor, "*s 6"]) -> Float[Tensor, "*s 6"]:
        """``Ad(x) ξ = [R ρ + t × R φ, R φ]``."""
        phi = rotate(x[..., 3:], xi[..., 3:])
        return concat((rotate(x[..., 3:], xi[..., :3]) + cross(x[..., :3], phi), phi))

    @staticmethod
    def right_jacobian(xi: Float[Tensor, "*s 6"]) -> Float[Tensor, "*s 6 6"]:
        """``J_r(ξ)``: blocks of SO(3)'s Jacobian and, beside them, ``Q``."""
        turning = so3.right_jacobian(xi[..., 3:])
        return _blocks(turning, _coupling(xi))

    @staticmethod
    def right_jacobian_inverse(xi: Float[Tensor, "*s 6"]) -> Float[Tensor, "*s 6 6"]:
        """``J_r(ξ)⁻¹``, for angles below 2π."""
        turning = so3.right_jacobian_inverse(xi[..., 3:])
        return _blocks(turning, -turning @ _coupling(xi) @ turning)


def _coupling(xi: Float[Tensor, "*s 6"]) -> Float[Tensor, "*s 3 3"]:
    """``Q(−ξ)``, Barfoot eq. 7.86: how a turn moves the position."""
    p, f = cross_matrix(-xi[..., :3]), cross_matrix(-xi[..., 3:])
    third, fourth, fifth = (
        c[..., None, None] for c in stumpff(so3.squared_angle(xi[..., 3:]), (3, 4, 5))
    )
    fp, pf = f @ p, p @ f
    fpf = fp @ f
    return (
        0.5 * p
        + third * (fp + pf + fpf)
        + fourth * (f @ fp + pf @ f - 3 * fpf)
        + 0.5 * (fourth - 3 * fifth) * (fpf @ f + f @ fpf)
    )


def _blocks(
    turning: Float[Tensor, "*s 3 3"], coupling: Float[Tensor, "*s 3 3"]
) -> Float[Tensor, "*s 6 6"]:
    """``[[J, Q], [0, J]]``."""
    above = torch.cat((turning, coupling), -1)
    below = torch.cat((torch.zeros_like(turning), turning), -1)
    return torch.cat((above, below), -2)
