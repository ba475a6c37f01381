"""Pre-integration of an IMU: many samples as one measurement between two states.

Forster, Carlone, Dellaert, Scaramuzza, "On-manifold preintegration for real-time visual-inertial
odometry", TRO 33(1), 2017; its equation numbers. States and increments are laid out as those of
``process.InertialProcess``, ``[p, v, q]``, errors as ``[δp, δv, δφ]`` with the rotation on the
right. A sample holds over the ``dt`` that follows it.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from coloc_env.geometry import (
    Se3,
    concat,
    cross_matrix,
    quaternion_exp,
    quaternion_matrix,
    quaternion_product,
    rotate,
    rotate_by,
    so3,
)
from coloc_env.observation import Observation
from coloc_env.sensors import GRAVITY


@dataclass(frozen=True)
class Preintegrated:
    """Relative motion over windows of samples, whatever the states at their starts.

    Attributes:
        increments: ``[Δp (m), Δv (m/s), ΔR (quaternion)]`` in the body frame at the start, as if
            there were no gravity.
        duration: seconds.
        covariance: of the increments' error, from white noise of the samples.
        bias: ``[accelerometer (m/s²), gyro (rad/s)]`` that was taken off the samples.
        bias_jacobian: derivative of the increments' error by the bias.
    """

    increments: Float[Tensor, "*s 10"]
    duration: Float[Tensor, "*s"]
    covariance: Float[Tensor, "*s 9 9"]
    bias: Float[Tensor, "*s 6"]
    bias_jacobian: Float[Tensor, "*s 9 6"]

    def corrected(self, bias: Float[Tensor, "*s 6"]) -> Float[Tensor, "*s 10"]:
        """The increments if ``bias`` had been taken off, to first order (eq. 44)."""
        shift = self.bias_jacobian @ (bias - self.bias).unsqueeze(-1)
        return perturb(self.increments, shift[..., 0])


def preintegrate(
    imu: Float[Tensor, "*s n 6"],
    dt: Float[Tensor, "*s n"],
    bias: Float[Tensor, "*s 6"],
    accel_std: float,
    gyro_std: float,
) -> Preintegrated:
    """Increments over windows of n samples (eq. 35), their covariance and bias Jacobian.

    No sample waits for the one before. Rotations up to each sample are a parallel prefix product,
    velocities and positions cumulative sums of what they turn, and the noise of sample k reaches
    the end through one matrix ``G_k``. So the covariance is one matrix product,
    ``Σ_k G_k Q G_kᵀ``, and the bias, which enters as noise with the other sign, has the Jacobian
    ``−Σ_k G_k``. These are the paper's recursions (eq. 63, appendices A and B) written out.

    Args:
        imu: ``[specific force (m/s²), angular rate (rad/s)]``, body frame.
        dt: seconds that each sample holds; 0 pads a short window.
        bias: ``[accelerometer, gyro]``, to be taken off every sample.
        accel_std, gyro_std: white noise of one sample, as in ``sensors.Imu``.

    Raises:
        ValueError: shapes that do not agree, or a window without samples.
    """
    if imu.shape != (*dt.shape, 6) or bias.shape != (*dt.shape[:-1], 6) or not dt.shape[-1]:
        raise ValueError(
            f"imu {tuple(imu.shape)}, dt {tuple(dt.shape)}, bias {tuple(bias.shape)}: "
            "must be [*s, n, 6], [*s, n] and [*s, 6] with n ≥ 1"
        )
    force, rate = (imu - bias.unsqueeze(-2)).split(3, -1)
    h = dt.unsqueeze(-1)
    after = _prefix_products(quaternion_exp(rate * h))  # ΔR at the end of each sample
    start = after.new_tensor((1.0, 0.0, 0.0, 0.0)).expand_as(after[..., :1, :])
    before = torch.cat((start, after[..., :-1, :]), -2)
    kick = rotate(before, force) * h
    velocity = kick.cumsum(-2)
    position = ((velocity - 0.5 * kick) * h).cumsum(-2)
    left = (dt.sum(-1, keepdim=True) - dt.cumsum(-1)).unsqueeze(-1)  # seconds to the end
    turn, at_end = quaternion_matrix(after), quaternion_matrix(after[..., -1:, :])
    forced = quaternion_matrix(before) * h.unsqueeze(-1)
    turned = turn @ so3.right_jacobian(rate * h) * h.unsqueeze(-1)
    still_to_go = position[..., -1:, :] - position - velocity * left
    still_to_gain = velocity[..., -1:, :] - velocity
    by_force = ((0.5 * h + left).unsqueeze(-1) * forced, forced, torch.zeros_like(forced))
    by_rate = (
        -cross_matrix(still_to_go) @ turned,
        -cross_matrix(still_to_gain) @ turned,
        at_end.mT @ turned,
    )
    effect = torch.cat((torch.cat(by_force, -2), torch.cat(by_rate, -2)), -1)  # G_k
    std = imu.new_tensor([accel_std] * 3 + [gyro_std] * 3)
    noise = (effect * std).transpose(-3, -2).flatten(-2)  # all G_k √Q side by side
    return Preintegrated(
        increments=concat((position[..., -1, :], velocity[..., -1, :], after[..., -1, :])),
        duration=dt.sum(-1),
        covariance=noise @ noise.mT,
        bias=bias,
        bias_jacobian=-effect.sum(-3),
    )


def samples_in(
    observation: Observation, dt: Float64[Tensor, "B N"]
) -> tuple[Float64[Tensor, "B N S 6"], Float64[Tensor, "B N S"]]:
    """The IMU's samples in a step of ``dt`` s, or their mean where there is only that, and for how
    long each holds (s)."""
    if "imu_samples" not in observation:
        return observation["imu"].double().unsqueeze(-2), dt.unsqueeze(-1)
    samples = observation["imu_samples"].double().unflatten(-1, (-1, 6))
    return samples, observation["imu_held"].double() * (dt > 0).unsqueeze(-1)


def predict(
    x: Float[Tensor, "*s 10"], increments: Float[Tensor, "*s 10"], duration: Float[Tensor, "*s"]
) -> Float[Tensor, "*s 10"]:
    """The state ``[p, v, q]`` in the world ``duration`` seconds after ``x`` (eq. 33)."""
    t = duration.unsqueeze(-1)
    fall = x.new_tensor((0.0, 0.0, -GRAVITY)) * t  # of the velocity
    pose = Se3.compose(_pose(x), _pose(increments))
    velocity = x[..., 3:6] + fall + rotate(x[..., 6:], increments[..., 3:6])
    return concat((pose[..., :3] + (x[..., 3:6] + 0.5 * fall) * t, velocity, pose[..., 3:]))


def transition(
    x: Float[Tensor, "*s 10"], window: Preintegrated
) -> tuple[Float[Tensor, "*s 9 15"], Float[Tensor, "*s 9 9"]]:
    """Derivative of the predicted state's error by the error ``[δp, δv, δφ, δb_a, δb_g]`` of the
    state and bias at the start (at the window's own bias), and the covariance of the window's
    noise, as it enters."""
    rotation = quaternion_matrix(x[..., 6:])
    position, velocity, turn = window.increments.split((3, 3, 4), -1)
    eye = torch.eye(3, dtype=x.dtype, device=x.device).expand_as(rotation)
    zero, t = torch.zeros_like(rotation), window.duration[..., None, None]
    state = torch.cat(
        (
            torch.cat((eye, t * eye, -rotation @ cross_matrix(position)), -1),
            torch.cat((zero, eye, -rotation @ cross_matrix(velocity)), -1),
            torch.cat((zero, zero, quaternion_matrix(turn).mT), -1),
        ),
        -2,
    )
    into = torch.cat(
        (
            torch.cat((rotation, zero, zero), -1),
            torch.cat((zero, rotation, zero), -1),
            torch.cat((zero, zero, eye), -1),
        ),
        -2,
    )
    return torch.cat((state, into @ window.bias_jacobian), -1), into @ window.covariance @ into.mT


def perturb(
    increments: Float[Tensor, "*s 10"], delta: Float[Tensor, "*s 9"]
) -> Float[Tensor, "*s 10"]:
    """Increments with an error ``[δp, δv, δφ]``: a change of bias or a draw of noise."""
    linear = increments[..., :6] + delta[..., :6]
    return concat((linear, rotate_by(increments[..., 6:], delta[..., 6:])))


def _pose(x: Float[Tensor, "*s 10"]) -> Float[Tensor, "*s 7"]:
    return concat((x[..., :3], x[..., 6:]))


def _prefix_products(q: Float[Tensor, "*s n 4"]) -> Float[Tensor, "*s n 4"]:
    """``q_1 ⊗ … ⊗ q_k`` for every k, in log₂ n rounds (Hillis and Steele 1986)."""
    reach = 1
    while reach < q.shape[-2]:
        longer = quaternion_product(q[..., :-reach, :], q[..., reach:, :])
        q = torch.cat((q[..., :reach, :], longer), -2)
        reach *= 2
    return q
