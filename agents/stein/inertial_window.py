"""The window of a team that moves by its IMUs: what each match says of present states.

A match is measured at one time, and says something of poses *and* velocities now, as far as IMUs
have integrated since: see ``galilean.coasted``.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.stein import match_window
from agents.stein.galilean import Galilean
from agents.stein.match_window import Matches, MatchWindow, agents_of
from agents.stein.odometry import Motion
from agents.tensorclasses import build
from coloc_env.geometry import Se3
from coloc_env.sensors import GRAVITY


class InertialWindow(MatchWindow):
    """Matches T moved along to A_i⁻¹ T A_j, their ``age`` τ (s) and the ``covariance`` of what they
    are now, from their own noise and the IMUs' white noise; ``added_variance``: what biases of the
    IMUs add; batch (B, H)."""

    age: Float64[Tensor, "B H W"]
    covariance: Float64[Tensor, "B H W 6 6"]


@dataclass(frozen=True)
class InertialNoise:
    """Standard deviations of a match (m, rad), of an IMU's mean over a step of ``dt`` s (m/s²,
    rad/s), and of the biases that are left in it."""

    match: tuple[float, float]
    accel: float
    gyro: float
    accel_bias: float
    gyro_bias: float
    dt: float

    def of_match(self, like: Tensor) -> Float64[Tensor, "6 6"]:
        """The covariance of a match as it is measured."""
        std, turn = self.match
        return torch.diag(like.new_tensor([std**2] * 3 + [turn**2] * 3))

    def of_step(self, age: Float64[Tensor, "*s"]) -> Float64[Tensor, "*s 6"]:
        """Variances of the recoil A(τ) over one step: Δv is off by σ_a dt, Δp by half of that
        times dt, Δφ by σ_g dt."""
        shift = (self.accel * self.dt * (age - 0.5 * self.dt)).square()
        turn = torch.full_like(age, (self.gyro * self.dt) ** 2)
        return torch.stack((shift,) * 3 + (turn,) * 3, -1)

    def of_biases(self, age: Float64[Tensor, "*s"]) -> Float64[Tensor, "*s 2"]:
        """Variances of position and rotation by both ends' biases b over τ: ½ τ² b_a, and as
        gravity is turned with the body, τ³/6 g b_g; τ b_g."""
        shift = (0.5 * self.accel_bias * age**2).square()
        shift = shift + (GRAVITY / 6 * self.gyro_bias * age**3).square()
        return 2 * torch.stack((shift, (self.gyro_bias * age).square()), -1)


def empty(shape: torch.Size, size: int, like: Tensor) -> InertialWindow:
    """A window of ``size`` empty slots."""
    none = match_window.empty(Se3, shape, size, like)
    return build(
        InertialWindow,
        shape,
        **dict(none.items()),
        age=like.new_zeros(*shape, size),
        covariance=torch.eye(6, dtype=like.dtype, device=like.device).repeat(*shape, size, 1, 1),
    )


def propagate(
    window: InertialWindow, motion: Motion, dt: Float64[Tensor, "B H"], noise: InertialNoise
) -> InertialWindow:
    """T ← A_i⁻¹ T A_j, ``dt`` s later; its error is Ad(A_j⁻¹) ε + η_j − Ad(T⁻¹) η_i."""
    age = window.age + dt.unsqueeze(-1)
    first, second = window.first, window.second
    here, there = (Galilean.recoil(agents_of(motion.moved, i), age) for i in (first, second))
    pose = Se3.between(here, Se3.compose(window.pose, there))
    carried = Se3.adjoint(Se3.inverse(there))
    turned = Se3.adjoint(Se3.inverse(pose))
    one = noise.of_step(age)
    by_first, by_second = (agents_of(motion.steps, i).unsqueeze(-1) * one for i in (first, second))
    covariance = carried @ window.covariance @ carried.mT
    covariance = covariance + (turned * by_first.unsqueeze(-2)) @ turned.mT
    return window.replace(
        pose=pose,
        age=age,
        covariance=covariance + torch.diag_embed(by_second),
        added_variance=noise.of_biases(age),
    )


def insert(window: InertialWindow, new: Matches, noise: InertialNoise) -> InertialWindow:
    """The window with the new matches in place of the oldest ones."""
    zero = torch.zeros_like(new.pose[..., :2])
    covariance = noise.of_match(zero).expand(*new.mask.shape, 6, 6)
    more = {"added_variance": zero, "age": zero[..., 0], "covariance": covariance}
    return build(InertialWindow, window.cursor.shape, **match_window.inserted(window, new, **more))
