"""SE(2): poses in the plane, ``[x, y, θ]`` (Solà et al. 2018, "A micro Lie theory", section E)."""

import torch
from jaxtyping import Float
from torch import Tensor

from coloc_env.geometry.coefficients import inverse_coefficient, stumpff
from coloc_env.geometry.poses import Poses, Pulls
from coloc_env.geometry.rotations import join, wrap_angle, yaw_quaternion


class Se2(Poses):
    """Poses in the plane; headings are kept in [-π, π)."""

    dim, dof, size = 2, 3, 3

    @staticmethod
    def quaternion(x: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 4"]:
        """The attitude as a quaternion."""
        return yaw_quaternion(x[..., 2])

    @staticmethod
    def exp(xi: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 3"]:
        """Tangent vector to pose."""
        u, v, angle = xi.unbind(-1)
        along, across = _arc(angle)
        return join((along * u - across * v, across * u + along * v, wrap_angle(angle)))

    @staticmethod
    def log(x: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 3"]:
        """Pose to the tangent vector of angle at most π."""
        px, py, heading = x.unbind(-1)
        angle = wrap_angle(heading)
        along, half = _chord(angle)
        return join((along * px + half * py, along * py - half * px, angle))

    @staticmethod
    def compose(a: Float[Tensor, "*s 3"], b: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 3"]:
        """``a b``: first ``b``, then ``a``."""
        (ax, ay, a_heading), (bx, by, b_heading) = a.unbind(-1), b.unbind(-1)
        cosine, sine = a_heading.cos(), a_heading.sin()
        return join(
            (
                ax + cosine * bx - sine * by,
                ay + sine * bx + cosine * by,
                wrap_angle(a_heading + b_heading),
            )
        )

    @staticmethod
    def between(a: Float[Tensor, "*s 3"], b: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 3"]:
        """``a⁻¹ b``: the pose of ``b`` as seen from ``a``."""
        (ax, ay, a_heading), (bx, by, b_heading) = a.unbind(-1), b.unbind(-1)
        cosine, sine, dx, dy = a_heading.cos(), a_heading.sin(), bx - ax, by - ay
        return join(
            (cosine * dx + sine * dy, cosine * dy - sine * dx, wrap_angle(b_heading - a_heading))
        )

    @classmethod
    def pulls(
        cls, x: Float[Tensor, "*s m 3"], y: Float[Tensor, "*s n 3"], weight: Float[Tensor, "*s n"]
    ) -> Pulls:
        """``Σ_n w_n (y_n ⊟ x_m)``, and the same sums of squares, by products of m × n matrices: in
        the plane rotations commute, so ``V⁻¹ R_mᵀ (t_n − t_m) = R_mᵀ V⁻¹ (t_n − t_m)``. Squares of
        positions are exact to about 1e-15 of the positions' own size squared. Not differentiable
        where two headings are the same."""
        there, w = y[..., :2], weight.unsqueeze(-1)
        turns = y[..., 2] / (2 * torch.pi), x[..., 2] / (2 * torch.pi)
        half = turns[0].unsqueeze(-2) - turns[1].unsqueeze(-1)
        half -= half.round()  # in place: memory's first use costs more than the arithmetic
        half *= torch.pi
        half += torch.finfo(x.dtype).tiny
        along = half.tan().reciprocal_().mul_(half)  # ½θ cot ½θ
        columns = torch.cat((w * there, w), -1)
        here, angles = x[..., :2], half @ columns
        (a, b), (c, d) = (_apart(sums, here).unbind(-1) for sums in (along @ columns, angles))
        u, v = a + d, b - c  # Σ w V⁻¹ (t_n − t_m)
        cosine, sine = x[..., 2].cos(), x[..., 2].sin()
        squared = half * half
        sizes = torch.addcmul(squared, along, along)  # |V⁻¹ p|² / |p|²
        sums = sizes @ torch.cat((columns, w * there.square().sum(-1, keepdim=True)), -1)
        position = sums[..., 3] + (here * (sums[..., 2:3] * here - 2 * sums[..., :2])).sum(-1)
        return Pulls(
            join((cosine * u + sine * v, cosine * v - sine * u, 2 * angles[..., 2])),
            position.clamp_min(0.0),
            4 * (squared @ w)[..., 0],
        )

    @staticmethod
    def carry(x: Float[Tensor, "*s 3"], xi: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 3"]:
        """``Ad(x) ξ = [R ρ + φ (y, −x), φ]``."""
        (px, py, heading), (u, v, angle) = x.unbind(-1), xi.unbind(-1)
        cosine, sine = heading.cos(), heading.sin()
        turned = (cosine * u - sine * v + angle * py, sine * u + cosine * v - angle * px)
        return join((*turned, angle.expand_as(turned[0])))

    @staticmethod
    def right_jacobian(xi: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 3 3"]:
        """``J_r(ξ)``, Solà et al. eq. 163."""
        u, v, angle = xi.unbind(-1)
        second, third = stumpff(angle * angle, (2, 3))
        along, across = _arc(angle)
        third = third * angle
        last = (third * u - second * v, second * u + third * v)
        return _upper((along, across, last[0], -across, along, last[1]))

    @staticmethod
    def right_jacobian_inverse(xi: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 3 3"]:
        """``J_r(ξ)⁻¹``, for angles below 2π."""
        u, v, angle = xi.unbind(-1)
        along, half = _chord(angle)
        turn = angle * inverse_coefficient(angle * angle)
        last = (turn * u + 0.5 * v, turn * v - 0.5 * u)
        return _upper((along, -half, last[0], half, along, last[1]))


def _apart(sums: Float[Tensor, "*s m 3"], t: Float[Tensor, "*s m 2"]) -> Float[Tensor, "*s m 2"]:
    """``Σ_n a_mn (t_n − t_m)`` from ``Σ_n a_mn t_n`` and ``Σ_n a_mn``."""
    return sums[..., :2] - sums[..., 2:] * t


def _arc(angle: Float[Tensor, "*s"]) -> tuple[Tensor, Tensor]:
    """``sin θ / θ`` and ``(1 − cos θ)/θ``: where a unit path that turns by θ leads."""
    half = 0.5 * angle
    (chord,) = stumpff(half * half, (1,))
    return chord * half.cos(), chord * half.sin()


def _chord(angle: Float[Tensor, "*s"]) -> tuple[Tensor, Tensor]:
    """``½θ cot ½θ`` and ``½θ``: the inverse of ``_arc``'s matrix."""
    squared = angle * angle
    return 1 - squared * inverse_coefficient(squared), 0.5 * angle


def _upper(rows: tuple[Tensor, ...]) -> Float[Tensor, "*s 3 3"]:
    """The matrix of two rows given and ``[0, 0, 1]``."""
    zero, one = torch.zeros_like(rows[0]), torch.ones_like(rows[0])
    return join((*rows, zero, zero, one)).unflatten(-1, (3, 3))
