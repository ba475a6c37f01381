"""Collaborative Stein particle filter (Arita & Namerikawa): Stein particles that agree with each
other by relaxed ADMM.

Every UAV holds m particles, each a joint guess of the whole team's poses relative to UAV 0 (eq.
14). Stein variational gradient descent with Gauss–Newton targets moves them (eqs. 15–17), consensus
variables on the edges draw the holders together (eq. 21).
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.localizer import Estimate
from agents.particle.belief import normal, own_keys
from agents.stein import consensus, reckoning
from agents.stein import window as windows
from agents.stein.estimate import covariance, map_estimate
from agents.stein.likelihood import Factors, Fit, Scale, compare, factors, fit, outlier_level
from agents.stein.neighbourhood import fit_neighbours
from agents.stein.reckoning import Moves, Tracks
from agents.stein.team import RelativeTeam
from agents.stein.update import kernel, stein_step
from agents.stein.window import Window
from agents.tensorclasses import build
from coloc_env import noise
from coloc_env.observation import Observation
from coloc_env.scenario import Believed

Variant = Literal["settled", "neighbourhood", "paper_corrected", "paper"]

_NEVER = 1 << 20  # steps after which nothing is annealed any more
_FEW = 10  # matches: with fewer, a small share of inliers says nothing


class SteinBelief(TensorClass):
    """Particles and estimate of each holder, its edges' variables (``started``: which hold
    something), what it remembers of matches and tracks, UAV 0's pose in the world when it was last
    heard, the annealing's age in steps, the share of inliers among the matches remembered, its key
    and steps taken; batch (B, H)."""

    x: Float64[Tensor, "B H N m P"]
    estimate: Float64[Tensor, "B H N P"]
    edges: Float64[Tensor, "B H R N P"]
    started: Bool[Tensor, "B H R"]
    window: Window
    tracks: Tracks
    origin: Float64[Tensor, "B H P"]
    annealed: Int64[Tensor, "B H"]
    inliers: Float64[Tensor, "B H"]
    key: Int64[Tensor, "B H"]
    step: Int64[Tensor, "B H"]


@dataclass(frozen=True)
class _Now:
    """What a step's iterations work with."""

    window: Window
    known: Factors
    scale: Scale
    beta: Float64[Tensor, "B H"]
    talking: Bool[Tensor, "B H R"]


class SteinFilter(RelativeTeam[SteinBelief]):
    """Stein particles of the team's poses, one cloud a UAV, that agree by consensus.

    ``particles`` a UAV (one: annealed Gauss–Newton), ``iterations`` a step, ``window``: matches
    remembered. ``gamma``: penalty of the consensus, shared by a UAV's edges (each with one of its
    own, a large team would listen to nothing else), ``eta`` its step; ``repulsion`` and ``pace`` of
    the Stein step; ``anneal``: by what factor the scale of matches shrinks in a step; a holder
    whose matches are inliers to a share below ``restart`` begins anew. ``outliers``: share of wrong
    matches believed. ``broadcast=true`` tells a match to all that hear its first end.
    ``variant``: ``neighbourhood`` has the paper's target (eq. 16) in this filter, ``paper`` the
    paper as printed, ``paper_corrected`` that with the sign of eq. 21 set right.
    """

    name = "cspf"

    def __init__(
        self,
        believed: Believed,
        *,
        particles: int = 50,
        iterations: int = 2,
        window: int = 30,
        gamma: float = 1.0,
        eta: float = 1.0,
        repulsion: float = 0.1,
        pace: float = 0.5,
        anneal: float = 0.96,
        restart: float = 0.1,
        outliers: float = 0.2,
        consensus: bool = True,
        broadcast: bool = False,
        variant: Variant = "settled",
        seed: int = 0,
    ) -> None:
        literal = variant.startswith("paper")
        super().__init__(believed, outliers, anneal)
        for key, value, least in (
            ("particles", particles, 1),
            ("iterations", iterations, 1),
            ("window", window, self.matches.matches),
        ):
            if value < least:
                raise ValueError(f"{key}={value} is not allowed: at least {least}")
        for key, size in (("gamma", gamma), ("eta", eta), ("pace", pace)):
            if not size > 0:
                raise ValueError(f"{key}={size} is not allowed: a number > 0")
        for key, size in (("repulsion", repulsion), ("restart", restart)):
            if not size >= 0:
                raise ValueError(f"{key}={size} is not allowed: a number ≥ 0")
        self.particles, self.iterations, self.seed = particles, iterations, seed
        self.window = self.matches.matches if literal else window
        self.gamma, self.pace = gamma / max(1, believed.arena.n_uavs - 1), pace
        self.repulsion = repulsion if particles > 1 else 0.0  # of itself, by rounding: up to 1e-5 m
        self.eta = -eta if variant == "paper" else eta
        self.restart = 0.0 if literal else restart
        self.consensus, self.broadcast = consensus, broadcast
        self.literal, self.across = literal, variant != "settled"
        self._parts = torch.tensor((self.poses.dim, self.poses.dof - self.poses.dim))

    def reset(self, observation: Observation) -> SteinBelief:
        key, origin = own_keys(observation, self.seed), observation["reference"].double()
        b, n = key.shape
        x = self._anywhere(key, origin)
        estimate = x[..., 0, :].contiguous()
        return SteinBelief(
            x=x,
            estimate=estimate,
            edges=estimate.unsqueeze(2).expand(-1, -1, n, -1, -1).contiguous(),
            started=torch.zeros(b, n, n, dtype=torch.bool, device=key.device),
            window=windows.empty(self.poses, key.shape, self.window, origin),
            tracks=reckoning.begun(self.poses, key.shape, origin),
            origin=origin,
            annealed=torch.zeros_like(key),
            inliers=torch.ones_like(origin[..., 0]),
            key=key,
            step=torch.zeros_like(key),
            batch_size=key.shape,
        )

    def step(self, belief: SteinBelief, observation: Observation) -> tuple[SteinBelief, Estimate]:
        poses, shape = self.poses, belief.step.shape
        heard = observation["links"] > 0
        known = heard | torch.eye(shape[1], dtype=torch.bool, device=heard.device)
        dt = (belief.step > 0).double() * self.believed.arena.dt
        tracks, moves = reckoning.told(poses, belief.tracks, observation, dt, known)
        window = windows.moved(poses, belief.window, moves.step, (self.std[0], self.std[-1]))
        window = windows.stored(window, windows.matches(poses, observation, known, self.broadcast))
        origin = torch.where(known[..., :1], observation["reference"].double(), belief.origin)
        scale = self._scale(belief)
        now = _Now(
            window=window,
            known=factors(poses, window, scale, shape[1]),
            scale=scale,
            beta=outlier_level(poses, scale, self.outliers, self.volume),
            talking=heard & heard.mT,
        )
        x = self._predicted(belief, moves)
        edges = reckoning.carried(poses, belief.edges, moves.step.unsqueeze(2))
        started = belief.started
        for _ in range(self.iterations):
            x, estimate, edges, started = self._iterated(x, edges, started, now)
        here = estimate.unsqueeze(-2)
        inliers = compare(poses, here, window, now.known, scale, now.beta)[1][..., 0]
        held = window.held.sum(-1)
        share = inliers.sum(-1) / held.clamp_min(1)
        lost = (share < self.restart) & (held >= min(_FEW, self.window))
        lost = lost & (scale.position <= self.matches.std)
        if bool(lost.any()):
            fresh = self._anywhere(noise.fold(belief.key, belief.step), origin)
            x = torch.where(lost[..., None, None, None], fresh, x)
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
            annealed=torch.where(lost, 0, belief.annealed + 1),
            inliers=share,
            key=belief.key,
            step=belief.step + 1,
        )
        own = torch.arange(shape[1], device=origin.device)
        spread = covariance(
            poses, estimate, window, inliers, now.known, scale, origin.new_tensor(self.uniform)
        )
        blocks = spread[..., : poses.dim, : poses.dim]
        return after, self.said(estimate[:, own, own], blocks, origin, observation, dt > 0)

    def team(self, belief: SteinBelief) -> Float[Tensor, "B H N P"]:
        return belief.estimate

    def diagnostics(self, belief: SteinBelief) -> dict[str, Float[Tensor, "B N"]]:
        return {"inlier_share": belief.inliers}

    def _scale(self, belief: SteinBelief) -> Scale:
        """The annealed scale; as printed, that of the sensor from the start."""
        return self.scale(belief.annealed + (_NEVER if self.literal else 0))

    def _anywhere(
        self, key: Int64[Tensor, "B H"], origin: Float64[Tensor, "B H P"]
    ) -> Float64[Tensor, "B H N m P"]:
        """Each holder's guesses before any match; UAV 0 is where it is."""
        x = self.anywhere(key, origin, key.shape[1], self.particles)
        first = torch.arange(key.shape[1], device=key.device) == 0
        return torch.where(first[:, None, None], self.poses.identity(x), x)

    def _predicted(self, belief: SteinBelief, moves: Moves) -> Float64[Tensor, "B H N m P"]:
        """D_0⁻¹ x D_j, each particle with noise of its own on every D (eq. 29); a single one moves
        without noise."""
        poses, n = self.poses, belief.step.shape[1]
        step = moves.step.unsqueeze(2)
        if self.particles > 1 and any(self.std):
            key = noise.fold(belief.key, belief.step)
            draws = normal(key, "cspf.step", n * poses.dof, self.particles).double()
            draws = draws.unflatten(-1, (n, -1)) * draws.new_tensor(self.std)
            step = poses.plus(
                step, draws * moves.steps.to(torch.float32).sqrt()[:, :, None, :, None]
            )
        return reckoning.carried(poses, belief.x.transpose(2, 3), step).transpose(2, 3)

    def _iterated(
        self,
        x: Float64[Tensor, "B H N m P"],
        edges: Float64[Tensor, "B H R N P"],
        started: Bool[Tensor, "B H R"],
        now: _Now,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Lines 7 to 9 of Algorithm 1: particles by eq. 26, estimate, consensus by eq. 21."""
        poses, n = self.poses, x.shape[2]
        active = started & started.mT & now.talking
        told = edges.transpose(1, 2)
        target = self._target(x, now)
        steps, density = target.steps, target.log_density
        if self.consensus:
            toward = consensus.pulls(poses, x, told, active)
            steps = steps + self.gamma * toward.sum(2)
            density = density - 0.5 * self.gamma * self._squares(toward, now.scale)
        weight = target.weight + self.gamma * (n - 1)
        near = kernel(poses, x, now.scale)
        steps = steps / weight.repeat_interleave(self._parts.to(x.device), -1)
        phi = stein_step(near, steps.transpose(2, 3), weight.transpose(2, 3), self.repulsion)
        moved = poses.plus(x, self.pace * phi.transpose(2, 3))
        x = torch.cat((x[:, :, :1], moved[:, :, 1:]), 2)
        estimate = map_estimate(poses, x, density, near.k)
        if self.consensus:
            agreed = consensus.agreed(poses, edges, told, estimate, self.eta)
            fresh = now.talking & ~started
            edges = torch.where(active[..., None, None], agreed, edges)
            edges = torch.where(fresh[..., None, None], estimate.unsqueeze(2), edges)
        return x, estimate, edges, started | now.talking

    def _target(self, x: Float64[Tensor, "B H N m P"], now: _Now) -> Fit:
        """The target's Gauss–Newton steps: joint residuals, or across holders as printed."""
        if not self.across:
            return fit(self.poses, x, now.window, now.known, now.scale, now.beta)
        beta = torch.zeros_like(now.beta) if self.literal else now.beta
        return fit_neighbours(self.poses, x, now.window, now.scale, beta, now.talking)

    def _squares(
        self, tangent: Float64[Tensor, "B H R N m D"], scale: Scale
    ) -> Float64[Tensor, "B H m"]:
        """Squared distances to what the other ends say, in units of the scale, summed."""
        d, squares = self.poses.dim, tangent.square()
        position, turn = squares[..., :d].sum((2, 3, 5)), squares[..., d:].sum((2, 3, 5))
        one = scale.position.square().unsqueeze(-1), scale.turn.square().unsqueeze(-1)
        return position / one[0] + turn / one[1]
