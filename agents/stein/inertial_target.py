"""The posterior of states with velocities, and its Gauss–Newton steps (equations 15 to 17, 26)."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor
from torch.nn.functional import pad

from agents.stein import consensus
from agents.stein.galilean import coasted
from agents.stein.inertial_window import InertialWindow
from agents.stein.likelihood import Scale
from agents.stein.match_window import agents_of
from agents.stein.target import Direction, Pull, in_units
from agents.stein.update import Kernel, kernel, mean_over, repulsions, to_body, to_world
from coloc_env.geometry import Se3, unrotate

_UNIT = 1.0  # s: a velocity's scale is that of a position, over so long


@dataclass(frozen=True)
class InertialTarget:
    """By IMUs: matches in the ``window`` with their ``precision`` P and outlier level ``beta``;
    ``jacobian`` J of each by the tangents [ρ, φ, ν] of all E / 9 states but UAV 0's, and
    ``information`` Jᵀ P J. ``velocity_std``: of a velocity less UAV 0's, m/s; ``uniform``:
    variances of a pose that may be any."""

    window: InertialWindow
    precision: Float64[Tensor, "B H W 6 6"]
    beta: Float64[Tensor, "B H W"]
    jacobian: Float64[Tensor, "B H W 6 E"]
    information: Float64[Tensor, "B H W E E"]
    scale: Scale
    velocity_std: float
    uniform: tuple[float, ...]
    pull: Pull

    def direction(
        self,
        x: Float64[Tensor, "B H N m 10"],
        received: Float64[Tensor, "B H R N 10"],
        active: Bool[Tensor, "B H R"],
    ) -> Direction:
        residual, inliers, log_density = self._residuals(x)
        others = x[:, :, 1:]
        velocity = unrotate(others[..., 3:7], others[..., 7:]) / self.velocity_std
        log_density = log_density - 0.5 * velocity.square().sum((2, 4))
        gradient = -pad(velocity / self.velocity_std, (6, 0))  # of the prior: [B, H, N − 1, m, 9]
        diagonal = x.new_tensor([0.0] * 6 + [self.velocity_std**-2] * 3)
        units, gamma = self._units(), self.pull.gamma
        if self.pull.consensus:
            towards, squares = self._penalty(x, received, active)
            gradient = gradient + gamma * units[:, :, None, None] * towards[:, :, 1:]
            log_density = log_density - 0.5 * gamma * squares
        diagonal = diagonal + gamma * (x.shape[2] - 1) * units
        near = kernel(Se3, x[..., :7], self.scale)
        right = torch.stack((gradient, self._apart(near, units)[:, :, 1:]), -1)
        right = right.transpose(2, 3).flatten(3, 4)  # [B, H, m, E, 2]
        right[..., 0] += self._gradient(residual, inliers)
        information = self._summed(inliers)
        diagonal = diagonal.repeat(1, 1, x.shape[2] - 1).unsqueeze(2)
        information.diagonal(dim1=-2, dim2=-1).add_(diagonal)
        solved = torch.linalg.solve_ex(information, right)[0]  # H⁻¹ b, eq. 17
        steps, away = solved.unflatten(3, (-1, 9)).transpose(2, 3).unbind(-1)
        steps, away = (pad(each, (0, 0, 0, 0, 1, 0)) for each in (steps, away))  # UAV 0 stays
        return Direction(_shared(near, steps) + self.pull.repulsion * away, log_density, near.k)

    def inliers(self, estimate: Float64[Tensor, "B H N 10"]) -> Float64[Tensor, "B H W"]:
        return self._residuals(estimate.unsqueeze(-2))[1][..., 0]

    def position_covariance(
        self, estimate: Float64[Tensor, "B H N 10"], inliers: Float64[Tensor, "B H W"]
    ) -> Float64[Tensor, "B N 3 3"]:
        """From the inverse of the information Jᵀ P J + Λ of all states; UAV 0's is any."""
        n = estimate.shape[2]
        if n == 1:
            return estimate.new_zeros(*estimate.shape[:2], 3, 3)
        prior = [1 / v for v in self.uniform] + [self.velocity_std**-2] * 3
        information = self._summed(inliers.unsqueeze(-1))[:, :, 0]
        information.diagonal(dim1=-2, dim2=-1).add_(information.new_tensor(prior * (n - 1)))
        joint = torch.linalg.inv(information).unflatten(-1, (-1, 9)).unflatten(2, (-1, 9))
        holder = torch.arange(n, device=estimate.device)
        own = (holder - 1).clamp_min(0)
        return joint[:, holder, own, :3, own, :3].movedim(0, 1)

    def _residuals(
        self, x: Float64[Tensor, "B H N m 10"]
    ) -> tuple[Float64[Tensor, "B H W m 6"], Float64[Tensor, "B H W m"], Float64[Tensor, "B H m"]]:
        """r = log(T⁻¹ z_i⁻¹ z_j), responsibilities, and the log-density up to a constant."""
        age = self.window.age.unsqueeze(-1)
        ends = (coasted(agents_of(x, i), age) for i in (self.window.first, self.window.second))
        residual = Se3.minus(Se3.between(*ends), self.window.pose.unsqueeze(-2))
        distance = ((residual @ self.precision) * residual).sum(-1)
        gauss = torch.exp(-0.5 * distance)
        mixed = gauss + self.beta.unsqueeze(-1)
        mask = self.window.mask.unsqueeze(-1)
        inliers = torch.where(mask, gauss / mixed, 0.0)
        return residual, inliers, torch.where(mask, mixed.log(), 0.0).sum(-2)

    def _gradient(
        self, residual: Float64[Tensor, "B H W m 6"], inliers: Float64[Tensor, "B H W m"]
    ) -> Float64[Tensor, "B H m E"]:
        """−Σ ω Jᵀ P r."""
        residual = (inliers.unsqueeze(-1) * residual).transpose(2, 3).flatten(3)
        return -residual @ (self.precision @ self.jacobian).flatten(2, 3)

    def _summed(self, inliers: Float64[Tensor, "B H W m"]) -> Float64[Tensor, "B H m E E"]:
        """Σ ω Jᵀ P J."""
        return (inliers.mT @ self.information.flatten(3)).unflatten(-1, self.information.shape[3:])

    def _units(self) -> Float64[Tensor, "B H 9"]:
        """Information of one unit of the scale along each tangent."""
        p, r = self.scale.position, self.scale.turn
        return torch.stack((p,) * 3 + (r,) * 3 + (p / _UNIT,) * 3, -1) ** -2

    def _penalty(
        self, x: Float64[Tensor, "B H N m 10"], received: Tensor, active: Tensor
    ) -> tuple[Float64[Tensor, "B H N m 9"], Float64[Tensor, "B H m"]]:
        """Steps to the other ends' dual variables, and squared distances in units of the scale."""
        pose = consensus.penalty_steps(Se3, x[..., :7], received[..., :7], active)
        apart = received[..., None, 7:] - x[:, :, None, ..., 7:]  # [B, H, R, N, m, 3]
        apart = torch.where(active[..., None, None, None], apart, 0.0)
        velocity = unrotate(x[..., 3:7], apart.sum(2))
        squares = apart.square().sum((2, 3, 5)) * self._units()[..., -1:]
        return torch.cat((pose.tangent, velocity), -1), in_units(pose, self.scale) + squares

    @staticmethod
    def _apart(near: Kernel, units: Float64[Tensor, "B H 9"]) -> Float64[Tensor, "B H N m 9"]:
        """Σ_r ∇k_lr / Σ_r k_lr, the gradient by poses."""
        push = torch.cat(repulsions(near), -1) / near.k.sum(-1)[..., None, None]
        push = push * (units[..., :6] / near.bandwidth.unsqueeze(-1))[:, :, None, None]
        return pad(push, (0, 3)).transpose(2, 3)


def inertial_target(
    window: InertialWindow,
    scale: Scale,
    agents: int,
    *,
    match: tuple[float, float],
    outliers: float,
    volume: float,
    velocity_std: float,
    uniform: tuple[float, ...],
    pull: Pull,
) -> InertialTarget:
    """The target by a ``window`` whose matches have so much wider noise as ``scale`` is wider than
    that of a ``match`` (annealing)."""
    wide = torch.stack((scale.position, scale.turn), -1).square()
    wide = (wide - wide.new_tensor(match).square()).clamp_min(0.0).unsqueeze(2)
    added = (wide + window.added_variance).repeat_interleave(3, -1)
    root, _ = torch.linalg.cholesky_ex(window.covariance + torch.diag_embed(added))
    deviation = root.diagonal(dim1=-2, dim2=-1).prod(-1)  # √det Σ
    precision, jacobian = torch.cholesky_inverse(root), _jacobian(window, agents)
    return InertialTarget(
        window=window,
        precision=precision,
        beta=outliers / (1 - outliers) * (2 * math.pi) ** 3 * deviation / volume,
        jacobian=jacobian,
        information=jacobian.mT @ precision @ jacobian,
        scale=scale,
        velocity_std=velocity_std,
        uniform=uniform,
        pull=pull,
    )


def _jacobian(window: InertialWindow, agents: int) -> Float64[Tensor, "B H W 6 E"]:
    """Of z_i⁻¹ z_j by the states' tangents: [1, −τ] at the second end, as z = x − τ u, and
    −Ad(T⁻¹) times that at the first; UAV 0's are left out."""
    age = window.age
    second = torch.eye(6, 9, dtype=age.dtype, device=age.device).repeat(*age.shape, 1, 1)
    axis = torch.arange(3, device=age.device)
    second[..., axis, 6 + axis] = -age.unsqueeze(-1)
    first = -Se3.adjoint(Se3.inverse(window.pose)) @ second
    index = torch.arange(1, agents, device=age.device)
    ends = (window.first, window.second)
    here, there = ((i.unsqueeze(-1) == index).to(age.dtype)[..., None, :, None] for i in ends)
    return (here * first.unsqueeze(-2) + there * second.unsqueeze(-2)).flatten(-2)


def _shared(near: Kernel, steps: Float64[Tensor, "B H N m 9"]) -> Float64[Tensor, "B H N m 9"]:
    """Kernel-weighted means of the particles' steps, averaged in the common frame."""
    own = steps.transpose(2, 3).unflatten(-1, (3, 3))
    common = near.rotation.unsqueeze(-3)
    mean = mean_over(near, to_world(common, own).flatten(3)).unflatten(-1, own.shape[3:])
    return to_body(common, mean).flatten(-2).transpose(2, 3)
