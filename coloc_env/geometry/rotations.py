"""Rotations in 2-D and 3-D.

Conventions, stated once: quaternions are scalar-first ``[w, x, y, z]`` and map body to world; in
the plane an attitude is a heading in radians, ``[θ]``. Perturbations are on the right, in the body
frame: ``R ⊞ δ = R exp(δ)``. World frame ENU, body frame FLU.
"""

import torch
from jaxtyping import Float
from torch import Tensor

Parts = list[Tensor] | tuple[Tensor, ...]


def join(components: Parts) -> Float[Tensor, "*s n"]:
    """Scalars as the last dimension of one tensor, each of them contiguous in memory: elementwise
    work on components then runs at full speed however many vectors there are."""
    return torch.stack(tuple(components)).movedim(0, -1)


def concat(parts: Parts) -> Float[Tensor, "*s n"]:
    """Vectors side by side in the last dimension, in the memory order of ``join``."""
    return torch.cat([part.movedim(-1, 0) for part in parts]).movedim(0, -1)


def cross_matrix(v: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 3 3"]:
    """``[v]×``, so that ``[v]× w = v × w``."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return join((zero, -z, y, z, zero, -x, -y, x, zero)).unflatten(-1, (3, 3))


def cross(a: Float[Tensor, "*s 3"], b: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 3"]:
    """``a × b``."""
    (ax, ay, az), (bx, by, bz) = a.unbind(-1), b.unbind(-1)
    return join((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


def quaternion_product(a: Float[Tensor, "*s 4"], b: Float[Tensor, "*s 4"]) -> Float[Tensor, "*s 4"]:
    """Hamilton product ``a ⊗ b``: rotate by ``b`` first, then by ``a``."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return join(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        )
    )


def quaternion_conjugate(q: Float[Tensor, "*s 4"]) -> Float[Tensor, "*s 4"]:
    """The inverse rotation of a unit quaternion."""
    return concat((q[..., :1], -q[..., 1:]))


def quaternion_exp(v: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 4"]:
    """Rotation vector (rad) to unit quaternion; exact and differentiable at zero."""
    angle = _length(v)
    half = 0.5 * angle
    return concat((half.cos(), half.sin() / angle * v))


def quaternion_log(q: Float[Tensor, "*s 4"]) -> Float[Tensor, "*s 3"]:
    """Unit quaternion to the rotation vector of angle at most π; differentiable at identity."""
    q = torch.where(q[..., :1] < 0, -q, q)
    real, imaginary = q[..., :1], q[..., 1:]
    sine = _length(imaginary)
    return 4 * torch.atan(sine / (real + 1)) / sine * imaginary


def _length(v: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 1"]:
    """Norm that never is zero: the least positive number under the root keeps sin(x)/x and its
    gradient finite at zero and changes nothing elsewhere."""
    x, y, z = v.unbind(-1)
    squared = x * x + y * y + z * z
    return (squared + torch.finfo(v.dtype).tiny).sqrt().unsqueeze(-1)


def quaternion_matrix(q: Float[Tensor, "*s 4"]) -> Float[Tensor, "*s 3 3"]:
    """Rotation matrix of a unit quaternion."""
    w, x, y, z = q.unbind(-1)
    return join(
        (
            1 - 2 * (y * y + z * z),
            2 * (x * y - w * z),
            2 * (x * z + w * y),
            2 * (x * y + w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z - w * x),
            2 * (x * z - w * y),
            2 * (y * z + w * x),
            1 - 2 * (x * x + y * y),
        )
    ).unflatten(-1, (3, 3))


def yaw_quaternion(yaw: Float[Tensor, "*s"]) -> Float[Tensor, "*s 4"]:
    """Rotation about the world's vertical axis."""
    zero = torch.zeros_like(yaw)
    return join(((0.5 * yaw).cos(), zero, zero, (0.5 * yaw).sin()))


def level(attitude: Float[Tensor, "*s a"]) -> Float[Tensor, "*s a"]:
    """The attitude turned about the world's vertical so that its heading is 0: roll and pitch."""
    if attitude.shape[-1] == 1:
        return torch.zeros_like(attitude)
    forward = rotation_matrix(attitude)[..., 0]
    yaw = plane_angle(forward[..., 0], forward[..., 1])
    return quaternion_product(yaw_quaternion(-yaw), attitude)


def plane_angle(x: Float[Tensor, "*s"], y: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """Angle of (x, y) in (-π, π], like ``atan2(y, x)``.

    torch's atan2 rounds differently in vectorized bodies and tails, which would make a number
    depend on the batch it is computed in; atan does not.
    """
    slope = torch.where(y == 0, y, y / x.abs())  # of the half-plane x ≥ 0; 0 at the origin
    half_turn = torch.pi * (1 - 2 * (y < 0).to(y.dtype))
    angle = torch.atan(slope)
    return torch.where(x < 0, half_turn - angle, angle)


def wrap_angle(angle: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """The same angle in [-π, π)."""
    return torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi


def rotation_matrix(attitude: Float[Tensor, "*s a"]) -> Float[Tensor, "*s d d"]:
    """Body-to-world matrix of an attitude: quaternion (a = 4, d = 3) or heading (a = 1, d = 2)."""
    if attitude.shape[-1] == 4:
        return quaternion_matrix(attitude)
    cosine, sine = attitude.cos(), attitude.sin()
    return torch.cat((cosine, -sine, sine, cosine), -1).unflatten(-1, (2, 2))


def rotate_by(
    attitude: Float[Tensor, "*s a"], delta: Float[Tensor, "*s t"]
) -> Float[Tensor, "*s a"]:
    """``attitude ⊞ delta``: a right (body-frame) perturbation, t = 3 or 1."""
    if attitude.shape[-1] == 4:
        turned = quaternion_product(attitude, quaternion_exp(delta))
        w, x, y, z = turned.unbind(-1)
        return turned / (w * w + x * x + y * y + z * z).sqrt().unsqueeze(-1)
    return wrap_angle(attitude + delta)


def rotation_between(
    start: Float[Tensor, "*s a"], end: Float[Tensor, "*s a"]
) -> Float[Tensor, "*s t"]:
    """``end ⊟ start``: the body-frame rotation vector that takes ``start`` to ``end``."""
    if start.shape[-1] == 4:
        return quaternion_log(quaternion_product(quaternion_conjugate(start), end))
    return wrap_angle(end - start)


def rotate(attitude: Float[Tensor, "*s a"], v: Float[Tensor, "*s d"]) -> Float[Tensor, "*s d"]:
    """A body-frame vector in the world frame."""
    if attitude.shape[-1] == 4:
        w, x, y, z = attitude.unbind(-1)
        return _turn(w, (x, y, z), v)
    return _turn_plane(attitude[..., 0].cos(), attitude[..., 0].sin(), v)


def unrotate(attitude: Float[Tensor, "*s a"], v: Float[Tensor, "*s d"]) -> Float[Tensor, "*s d"]:
    """A world-frame vector in the body frame."""
    if attitude.shape[-1] == 4:
        w, x, y, z = attitude.unbind(-1)
        return _turn(-w, (x, y, z), v)
    return _turn_plane(attitude[..., 0].cos(), -attitude[..., 0].sin(), v)


def _turn(
    w: Float[Tensor, "*s"], u: tuple[Tensor, Tensor, Tensor], v: Float[Tensor, "*s 3"]
) -> Float[Tensor, "*s 3"]:
    """``v + 2w (u × v) + 2u × (u × v)``: a unit quaternion applied to a vector."""
    (x, y, z), (a, b, c) = u, v.unbind(-1)
    tx, ty, tz = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return join(
        (
            a + w * tx + (y * tz - z * ty),
            b + w * ty + (z * tx - x * tz),
            c + w * tz + (x * ty - y * tx),
        )
    )


def _turn_plane(
    cosine: Float[Tensor, "*s"], sine: Float[Tensor, "*s"], v: Float[Tensor, "*s 2"]
) -> Float[Tensor, "*s 2"]:
    a, b = v.unbind(-1)
    return join((cosine * a - sine * b, sine * a + cosine * b))
