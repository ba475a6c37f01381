"""Collaborative Stein particle filter (CSPF, Arita & Namerikawa): Stein particles with consensus by
relaxed ADMM.

Every UAV holds m particles, each a joint hypothesis of the team's poses relative to UAV 0 (equation
14). SVGD with Gauss–Newton steps moves them (equations 15 to 17); dual variables on the edges bring
the holders into consensus (equation 21).
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.localizer import Estimate
from agents.particle.belief import normal, own_keys
from agents.stein import consensus, odometry
from agents.stein import match_window as windows
from agents.stein.estimate import covariance, map_estimate
from agents.stein.likelihood import Factors, Fit, Scale, factors, fit, outlier_level, residuals
from agents.stein.match_window import MatchWindow
from agents.stein.neighbourhood import fit_neighbours
from agents.stein.odometry import Motion, Tracks
from agents.stein.team import RelativeTeam
from agents.stein.update import kernel, stein_step
from agents.tensorclasses import build
from coloc_env import noise
from coloc_env.geometry import Pulls
from coloc_env.observation import Observation
from coloc_env.options import Factor, OpenShare, PositiveCount, PositiveShare, Ratio, Share
from coloc_env.scenario import Believed

Variant = Literal["settled", "neighbourhood", "paper_corrected", "paper"]

_ANNEALED = 1 << 20  # steps: annealing has ended
_MIN_MATCHES = 10  # with fewer, the share of inliers is not tested


class SteinBelief(TensorClass):
    """Particles ``x`` and ``estimate`` of each holder, the dual variables of its ``edges``
    (``started``: which are initialized), its ``window`` of matches and ``tracks``, UAV 0's pose in
    the world as received last (``origin``), steps of annealing (``annealed``), the share of
    ``inliers`` among the matches in the window, its random key and steps taken; batch (B, H)."""

    x: Float64[Tensor, "B H N m P"]
    estimate: Float64[Tensor, "B H N P"]
    edges: Float64[Tensor, "B H R N P"]
    started: Bool[Tensor, "B H R"]
    window: MatchWindow
    tracks: Tracks
    origin: Float64[Tensor, "B H P"]
    annealed: Int64[Tensor, "B H"]
    inliers: Float64[Tensor, "B H"]
    key: Int64[Tensor, "B H"]
    step: Int64[Tensor, "B H"]


@dataclass(frozen=True)
class _StepInput:
    """What a step's iterations are computed from: the ``window`` and its ``factors``, the annealed
    ``scale``, the outlier level ``beta`` and which edges are ``active`` in both directions."""

    window: MatchWindow
    factors: Factors
    scale: Scale
    beta: Float64[Tensor, "B H"]
    active: Bool[Tensor, "B H R"]


class SteinFilter(RelativeTeam[SteinBelief]):
    """Stein particles of the team's poses, one set a UAV, with consensus.

    ``particles`` a UAV (one: annealed Gauss–Newton), ``iterations`` a step, ``window``: number of
    past matches. ``gamma``: ADMM penalty γ of a UAV, divided by its edges (γ for each edge would
    outweigh all matches in a large team); ``eta``: step size η of the dual variables;
    ``repulsion`` and ``pace`` of the Stein step; ``anneal``: factor of the scale of matches in a
    step; a holder whose share of inliers is below ``restart`` restarts. ``outliers``: believed
    share ε of wrong matches. ``broadcast=true`` sends a match to all that have a link to its first
    end. ``variant``: ``neighbourhood`` has the paper's target (equation 16) in this filter,
    ``paper`` is the paper as printed, ``paper_corrected`` with the sign of equation 21 corrected.
    """

    name = "cspf"

    def __init__(
        self,
        believed: Believed,
        *,
        particles: PositiveCount = 50,
        iterations: PositiveCount = 2,
        window: PositiveCount = 30,
        gamma: Factor = 1.0,
        eta: Factor = 1.0,
        repulsion: Ratio = 0.1,
        pace: Factor = 0.5,
        anneal: PositiveShare = 0.96,
        restart: Share = 0.1,
        outliers: OpenShare = 0.2,
        consensus: bool = True,
        broadcast: bool = False,
        variant: Variant = "settled",
        seed: int = 0,
    ) -> None:
        literal = variant.startswith("paper")
        super().__init__(believed, outliers, anneal)
        least = self.matches.matches  # of one step
        if window < least:
            raise ValueError(f"window={window} is not allowed: at least {least} is needed")
        self.particles, self.iterations, self.seed = particles, iterations, seed
        self.window = self.matches.matches if literal else window
        self.gamma, self.pace = gamma / max(1, believed.arena.n_uavs - 1), pace
        self.repulsion = repulsion if particles > 1 else 0.0  # of itself, by rounding: 1e-5 m
        self.eta = -eta if variant == "paper" else eta
        self.restart = 0.0 if literal else restart
        self.consensus, self.broadcast = consensus, broadcast
        self.literal, self.across = literal, variant != "settled"
        self._parts = torch.tensor((self.poses.dim, self.poses.dof - self.poses.dim))

    def reset(self, observation: Observation) -> SteinBelief:
        key, origin = own_keys(observation, self.seed), observation["reference"].double()
        b, n = key.shape
        x = self._initial_particles(key, origin)
        estimate = x[..., 0, :].contiguous()
        return SteinBelief(
            x=x,
            estimate=estimate,
            edges=estimate.unsqueeze(2).expand(-1, -1, n, -1, -1).contiguous(),
            started=torch.zeros(b, n, n, dtype=torch.bool, device=key.device),
            window=windows.empty(self.poses, key.shape, self.window, origin),
            tracks=odometry.initial(self.poses, key.shape, origin),
            origin=origin,
            annealed=torch.zeros_like(key),
            inliers=torch.ones_like(origin[..., 0]),
            key=key,
            step=torch.zeros_like(key),
            batch_size=key.shape,
        )

    def step(self, belief: SteinBelief, observation: Observation) -> tuple[SteinBelief, Estimate]:
        poses, shape = self.poses, belief.step.shape
        links = observation["links"] > 0
        linked = links | torch.eye(shape[1], dtype=torch.bool, device=links.device)
        dt = (belief.step > 0).double() * self.believed.arena.dt
        tracks, motion = odometry.exchange(poses, belief.tracks, observation, dt, linked)
        window = windows.propagate(poses, belief.window, motion.pose, (self.std[0], self.std[-1]))
        new = windows.observed_matches(poses, observation, linked, self.broadcast)
        window = windows.insert(window, new)
        origin = torch.where(linked[..., :1], observation["reference"].double(), belief.origin)
        scale = self._scale(belief)
        inputs = _StepInput(
            window=window,
            factors=factors(poses, window, scale, shape[1]),
            scale=scale,
            beta=outlier_level(poses, scale, self.outliers, self.volume),
            active=links & links.mT,
        )
        x = self._predict(belief, motion)
        edges = odometry.propagate(poses, belief.edges, motion.pose.unsqueeze(2))
        started = belief.started
        for _ in range(self.iterations):
            x, estimate, edges, started = self._iterate(x, edges, started, inputs)
        inliers = residuals(
            poses, estimate.unsqueeze(-2), window, inputs.factors, scale, inputs.beta
        )[1][..., 0]
        count = window.mask.sum(-1)
        share = inliers.sum(-1) / count.clamp_min(1)
        restart = (share < self.restart) & (count >= min(_MIN_MATCHES, self.window))
        restart = restart & (scale.position <= self.matches.std)
        if bool(restart.any()):
            initial = self._initial_particles(noise.fold(belief.key, belief.step), origin)
            x = torch.where(restart[..., None, None, None], initial, x)
        after = build(
            SteinBelief,
            shape,
            x=x,
            estimate=estimate,
            edges=edges,
            started=started,
            window=window,
            tracks=tracks,
            origin=origin,
            annealed=torch.where(restart, 0, belief.annealed + 1),
            inliers=share,
            key=belief.key,
            step=belief.step + 1,
        )
        own = torch.arange(shape[1], device=origin.device)
        prior = origin.new_tensor(self.uniform)
        whole = covariance(poses, estimate, window, inliers, inputs.factors, scale, prior)
        position = whole[..., : poses.dim, : poses.dim]
        return after, self.world_estimate(
            estimate[:, own, own], position, origin, observation, dt > 0
        )

    def team(self, belief: SteinBelief) -> Float[Tensor, "B H N P"]:
        return belief.estimate

    def diagnostics(self, belief: SteinBelief) -> dict[str, Float[Tensor, "B N"]]:
        return {"inlier_share": belief.inliers}

    def _scale(self, belief: SteinBelief) -> Scale:
        """The annealed scale; as printed, that of the sensor from the start."""
        return self.scale(belief.annealed + (_ANNEALED if self.literal else 0))

    def _initial_particles(
        self, key: Int64[Tensor, "B H"], origin: Float64[Tensor, "B H P"]
    ) -> Float64[Tensor, "B H N m P"]:
        """Each holder's particles before any match: uniform poses, the identity for UAV 0."""
        x = self.uniform_poses(key, origin, key.shape[1], self.particles)
        first = torch.arange(key.shape[1], device=key.device) == 0
        return torch.where(first[:, None, None], self.poses.identity(x), x)

    def _predict(self, belief: SteinBelief, motion: Motion) -> Float64[Tensor, "B H N m P"]:
        """x_j ← D_0⁻¹ x_j D_j (equation 29), each particle with noise of its own on every D; a
        single one without noise."""
        poses, n = self.poses, belief.step.shape[1]
        d = motion.pose.unsqueeze(2)
        if self.particles > 1 and any(self.std):
            key = noise.fold(belief.key, belief.step)
            draws = normal(key, "cspf.step", n * poses.dof, self.particles).double()
            draws = draws.unflatten(-1, (n, -1)) * draws.new_tensor(self.std)
            d = poses.plus(d, draws * motion.steps.to(torch.float32).sqrt()[:, :, None, :, None])
        return odometry.propagate(poses, belief.x.transpose(2, 3), d).transpose(2, 3)

    def _iterate(
        self,
        x: Float64[Tensor, "B H N m P"],
        edges: Float64[Tensor, "B H R N P"],
        started: Bool[Tensor, "B H R"],
        inputs: _StepInput,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Lines 7 to 9 of Algorithm 1: particles by equation 26, MAP estimate, dual variables by
        equation 21."""
        poses, n = self.poses, x.shape[2]
        active = started & started.mT & inputs.active
        received = edges.transpose(1, 2)
        target = self._target(x, inputs)
        steps, log_density = target.steps, target.log_density
        if self.consensus:
            penalty = consensus.penalty_steps(poses, x, received, active)
            steps = steps + self.gamma * penalty.tangent
            log_density = log_density - 0.5 * self.gamma * _in_units(penalty, inputs.scale)
        weight = target.weight + self.gamma * (n - 1)  # H, block-diagonal
        near = kernel(poses, x, inputs.scale)
        steps = steps / weight.repeat_interleave(self._parts.to(x.device), -1)  # H⁻¹ b, eq. 17
        phi = stein_step(near, steps.transpose(2, 3), weight.transpose(2, 3), self.repulsion)
        moved = poses.plus(x, self.pace * phi.transpose(2, 3))  # x exp(a φ*), eq. 15
        x = torch.cat((x[:, :, :1], moved[:, :, 1:]), 2)
        estimate = map_estimate(poses, x, log_density, near.k)
        if self.consensus:
            updated = consensus.dual_update(poses, edges, received, estimate, self.eta)
            first = inputs.active & ~started
            edges = torch.where(active[..., None, None], updated, edges)
            edges = torch.where(first[..., None, None], estimate.unsqueeze(2), edges)
        return x, estimate, edges, started | inputs.active

    def _target(self, x: Float64[Tensor, "B H N m P"], inputs: _StepInput) -> Fit:
        """The target's Gauss–Newton steps: by joint residuals, or by equation 16."""
        if not self.across:
            return fit(self.poses, x, inputs.window, inputs.factors, inputs.scale, inputs.beta)
        beta = torch.zeros_like(inputs.beta) if self.literal else inputs.beta
        return fit_neighbours(self.poses, x, inputs.window, inputs.scale, beta, inputs.active)


def _in_units(penalty: Pulls, scale: Scale) -> Float64[Tensor, "B H m"]:
    """Squared distances to the other ends' dual variables, in units of the scale, summed over
    agents."""
    position = penalty.position.sum(2) / scale.position.square().unsqueeze(-1)
    return position + penalty.turn.sum(2) / scale.turn.square().unsqueeze(-1)
