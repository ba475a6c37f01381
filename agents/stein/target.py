"""What a step's iterations move the particles to: the matches in the window, and other holders."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.stein import consensus
from agents.stein.estimate import covariance
from agents.stein.likelihood import Factors, Fit, Scale, fit, residuals
from agents.stein.match_window import MatchWindow
from agents.stein.neighbourhood import fit_neighbours
from agents.stein.update import kernel, stein_step
from coloc_env.geometry import Poses, Pulls


@dataclass(frozen=True)
class Pull:
    """``gamma``: ADMM penalty γ of an edge, and whether there is ``consensus`` at all; weight of
    the Stein step's ``repulsion``."""

    gamma: float
    consensus: bool
    repulsion: float


class Direction(NamedTuple):
    """The direction φ* of each particle, its log-density up to a constant, and the kernel."""

    phi: Float64[Tensor, "B H N m D"]
    log_density: Float64[Tensor, "B H m"]
    k: Float64[Tensor, "B H m m"]


class Target(Protocol):
    """The posterior in one step."""

    def direction(
        self,
        x: Float64[Tensor, "B H N m P"],
        received: Float64[Tensor, "B H R N P"],
        active: Bool[Tensor, "B H R"],
    ) -> Direction:
        """Of the Stein step (equations 15 and 26), with the dual variables ``received`` from the
        other ends of ``active`` edges."""

    def inliers(self, estimate: Float64[Tensor, "B H N P"]) -> Float64[Tensor, "B H W"]:
        """Each match's responsibility ω at an estimate."""

    def position_covariance(
        self, estimate: Float64[Tensor, "B H N P"], inliers: Float64[Tensor, "B H W"]
    ) -> Float64[Tensor, "B N d d"]:
        """Of each holder's own position, in its body frame (m²)."""


@dataclass(frozen=True)
class MatchTarget:
    """By odometry: the ``window`` and its ``factors``, the annealed ``scale``, the outlier level
    ``beta``; ``uniform``: variances of a pose that may be any. ``across``: equation 16 in place of
    joint residuals, between holders with ``active`` edges."""

    poses: type[Poses]
    window: MatchWindow
    factors: Factors
    scale: Scale
    beta: Float64[Tensor, "B H"]
    active: Bool[Tensor, "B H R"]
    uniform: tuple[float, ...]
    pull: Pull
    across: bool
    literal: bool

    def direction(self, x: Tensor, received: Tensor, active: Tensor) -> Direction:
        poses, n, gamma = self.poses, x.shape[2], self.pull.gamma
        target = self._fit(x)
        steps, log_density = target.steps, target.log_density
        if self.pull.consensus:
            penalty = consensus.penalty_steps(poses, x, received, active)
            steps = steps + gamma * penalty.tangent
            log_density = log_density - 0.5 * gamma * in_units(penalty, self.scale)
        weight = target.weight + gamma * (n - 1)  # H, block-diagonal
        near = kernel(poses, x, self.scale)
        parts = torch.tensor((poses.dim, poses.dof - poses.dim), device=x.device)
        steps = steps / weight.repeat_interleave(parts, -1)  # H⁻¹ b, eq. 17
        phi = stein_step(near, steps.transpose(2, 3), weight.transpose(2, 3), self.pull.repulsion)
        return Direction(phi.transpose(2, 3), log_density, near.k)

    def inliers(self, estimate: Tensor) -> Float64[Tensor, "B H W"]:
        x = estimate.unsqueeze(-2)
        found = residuals(self.poses, x, self.window, self.factors, self.scale, self.beta)
        return found[1][..., 0]

    def position_covariance(self, estimate: Tensor, inliers: Tensor) -> Float64[Tensor, "B N d d"]:
        prior, d = estimate.new_tensor(self.uniform), self.poses.dim
        whole = covariance(
            self.poses, estimate, self.window, inliers, self.factors, self.scale, prior
        )
        return whole[..., :d, :d]

    def _fit(self, x: Float64[Tensor, "B H N m P"]) -> Fit:
        """The target's Gauss–Newton steps: by joint residuals, or by equation 16."""
        if not self.across:
            return fit(self.poses, x, self.window, self.factors, self.scale, self.beta)
        beta = torch.zeros_like(self.beta) if self.literal else self.beta
        return fit_neighbours(self.poses, x, self.window, self.scale, beta, self.active)


def in_units(penalty: Pulls, scale: Scale) -> Float64[Tensor, "B H m"]:
    """Squared distances to the other ends' dual variables, in units of the scale, summed over
    agents."""
    position = penalty.position.sum(2) / scale.position.square().unsqueeze(-1)
    return position + penalty.turn.sum(2) / scale.turn.square().unsqueeze(-1)
