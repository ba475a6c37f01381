"""Pre-integrated motion as a group, and states relative to UAV 0 that it moves (CSPF paper,
equations 28 and 29).

An *increment* is ``[Δp (m), Δv (m/s), ΔR (quaternion), Δt (s)]``: what a UAV's IMU alone says of
its motion, in the body frame at its start, as if there were no gravity (see ``preintegration``).
Increments compose as elements of the Galilean group. A *state* is ``[pose (7), u (3)]``: a UAV's
pose relative to UAV 0's body frame, and its velocity less UAV 0's in that frame (m/s).

Gravity pulls all UAVs alike, so it is not in the motion of one relative to another: nobody needs to
know where down is, nor how fast UAV 0 moves.
"""

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.models.preintegration import preintegrate, samples_in
from coloc_env.geometry import Se3, concat, rotate, rotate_by, unrotate
from coloc_env.observation import Observation


class Galilean:
    """Increments as a group, as ``Poses`` has those of poses."""

    @staticmethod
    def identity(like: Float64[Tensor, "*s k"]) -> Float64[Tensor, "11"]:
        """No motion in no time."""
        return like.new_tensor((*(0.0,) * 6, 1.0, *(0.0,) * 4))

    @staticmethod
    def compose(
        a: Float64[Tensor, "*s 11"], b: Float64[Tensor, "*s 11"]
    ) -> Float64[Tensor, "*s 11"]:
        """First ``a``, then ``b``: [Δp_a + Δv_a Δt_b + ΔR_a Δp_b, Δv_a + ΔR_a Δv_b, ΔR_a ΔR_b]."""
        turn, t = a[..., 6:10], b[..., 10:]
        pose = Se3.compose(_pose(a, t), _pose(b, 0.0))
        velocity = a[..., 3:6] + rotate(turn, b[..., 3:6])
        return concat((pose[..., :3], velocity, pose[..., 3:], a[..., 10:] + t))

    @staticmethod
    def between(
        a: Float64[Tensor, "*s 11"], c: Float64[Tensor, "*s 11"]
    ) -> Float64[Tensor, "*s 11"]:
        """The b with ``compose(a, b) = c``."""
        t = c[..., 10:] - a[..., 10:]
        pose = Se3.between(_pose(a, t), _pose(c, 0.0))
        velocity = unrotate(a[..., 6:10], c[..., 3:6] - a[..., 3:6])
        return concat((pose[..., :3], velocity, pose[..., 3:], t))

    @staticmethod
    def perturb(
        d: Float64[Tensor, "*s 11"], error: Float64[Tensor, "*s 9"]
    ) -> Float64[Tensor, "*s 11"]:
        """With the error ``[δp, δv, δφ]``, the rotation's on the right."""
        turned = rotate_by(d[..., 6:10], error[..., 6:])
        return concat((d[..., :6] + error[..., :6], turned, d[..., 10:].expand_as(turned[..., :1])))

    @staticmethod
    def recoil(d: Float64[Tensor, "*s 11"], age: Float64[Tensor, "*s"]) -> Float64[Tensor, "*s 7"]:
        """A(τ) = [ΔR, Δp − τ Δv], which moves measurements τ = ``age`` s old: see ``coasted``."""
        return _pose(d, -age.unsqueeze(-1))


class RelativeStates:
    """States ``[pose, u]`` and their tangents ``[ρ, φ, ν]``, in the UAV's own body frame."""

    @staticmethod
    def plus(x: Float64[Tensor, "*s 10"], xi: Float64[Tensor, "*s 9"]) -> Float64[Tensor, "*s 10"]:
        """``x ⊞ ξ = [pose exp(ρ, φ), u + R ν]``."""
        pose = Se3.plus(x[..., :7], xi[..., :6])
        return concat((pose, x[..., 7:] + rotate(x[..., 3:7], xi[..., 6:])))

    @staticmethod
    def minus(y: Float64[Tensor, "*s 10"], x: Float64[Tensor, "*s 10"]) -> Float64[Tensor, "*s 9"]:
        """``y ⊟ x``: the tangent at ``x`` that leads to ``y``."""
        pose = Se3.minus(y[..., :7], x[..., :7])
        return concat((pose, unrotate(x[..., 3:7], y[..., 7:] - x[..., 7:])))


def imu_increments(
    observation: Observation, dt: Float64[Tensor, "B N"]
) -> Float64[Tensor, "B N 11"]:
    """Each UAV's pre-integrated samples of a step of ``dt`` s (equation 28); nothing of those that
    are not finite."""
    samples, held = samples_in(observation, dt)
    usable = samples.isfinite().all(-1) & held.isfinite()
    samples, held = torch.where(usable.unsqueeze(-1), samples, 0.0), torch.where(usable, held, 0.0)
    found = preintegrate(samples, held, torch.zeros_like(samples[..., 0, :]), 0.0, 0.0)
    return torch.cat((found.increments, found.duration.unsqueeze(-1)), -1)


def propagate(
    x: Float64[Tensor, "*s N 10"], motion: Float64[Tensor, "*s N 11"], dt: Float64[Tensor, "*s"]
) -> Float64[Tensor, "*s N 10"]:
    """States ``dt`` s later, relative to UAV 0 after its own ``motion``:

    x_j ← D₀⁻¹ [R_j, p_j + u_j dt] D_j, D = [ΔR, Δp], and u_j ← ΔR₀ᵀ (u_j + R_j Δv_j − Δv₀).

    That is equation 29 by equation 28, of each UAV less UAV 0. The motion of a UAV that is heard
    late may be of many steps; it acts on the state that has moved uniformly meanwhile.
    """
    here = motion[..., :1, :]
    ahead = coasted(x, -dt.unsqueeze(-1).expand(x.shape[:-1]))
    pose = Se3.between(_pose(here, 0.0), Se3.compose(ahead, _pose(motion, 0.0)))
    velocity = x[..., 7:] + rotate(x[..., 3:7], motion[..., 3:6]) - here[..., 3:6]
    return concat((pose, unrotate(here[..., 6:10], velocity)))


def coasted(x: Float64[Tensor, "*s 10"], age: Float64[Tensor, "*s"]) -> Float64[Tensor, "*s 7"]:
    """z = [R, p − τ u], the pose τ = ``age`` s ago had the UAV moved uniformly.

    A relative pose T of UAVs i and j measured τ s ago is T = A_i z_i⁻¹ z_j A_j⁻¹ by present states,
    A(τ) the ``recoil`` of what each one's IMU has integrated since.
    """
    return concat((x[..., :3] - age.unsqueeze(-1) * x[..., 7:], x[..., 3:7]))


def _pose(d: Float64[Tensor, "*s 11"], t: Tensor | float) -> Float64[Tensor, "*s 7"]:
    """[Δp + Δv t, ΔR]."""
    return concat((d[..., :3] + d[..., 3:6] * t, d[..., 6:10]))
