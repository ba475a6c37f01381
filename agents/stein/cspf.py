"""Collaborative Stein particle filter (CSPF, Arita & Namerikawa): Stein particles with consensus by
relaxed ADMM.

Every UAV holds m particles, each a joint hypothesis of the team's poses relative to UAV 0 (equation
14). SVGD with Gauss–Newton steps moves them (equations 15 to 17); dual variables on the edges bring
the holders into consensus (equation 21).
"""

from collections.abc import Sequence
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.localizer import Estimate, Localizer
from agents.particle.belief import normal, own_keys
from agents.stein import consensus, odometry
from agents.stein import match_window as windows
from agents.stein.estimate import States, map_estimate
from agents.stein.likelihood import Scale, factors, outlier_level
from agents.stein.match_window import Matches, MatchWindow
from agents.stein.odometry import Motion, Tracks
from agents.stein.target import MatchTarget, Pull, Target
from agents.stein.team import RelativeTeam
from agents.tensorclasses import build
from coloc_env import noise
from coloc_env.observation import Observation
from coloc_env.options import Factor, OpenShare, PositiveCount, PositiveShare, Ratio, Share
from coloc_env.scenario import Believed, Inertial

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
        self.group: odometry.Group = self.poses
        self.states: States = self.poses
        self.pull = Pull(self.gamma, consensus, self.repulsion)

    @classmethod
    def for_team(cls, believed: Believed, **options: Any) -> Localizer[Any]:
        """The filter; in a team that moves by its IMUs the one that pre-integrates them."""
        if not isinstance(believed.process, Inertial):
            return cls(believed, **options)
        from agents.stein.cspf_inertial import InertialSteinFilter

        return InertialSteinFilter(believed, **options)

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
            window=self._nothing(key.shape, origin),
            tracks=odometry.initial(self.group, key.shape, origin),
            origin=origin,
            annealed=torch.zeros_like(key),
            inliers=torch.ones_like(origin[..., 0]),
            key=key,
            step=torch.zeros_like(key),
            batch_size=key.shape,
        )

    def step(self, belief: SteinBelief, observation: Observation) -> tuple[SteinBelief, Estimate]:
        shape = belief.step.shape
        links = observation["links"] > 0
        linked = links | torch.eye(shape[1], dtype=torch.bool, device=links.device)
        dt = (belief.step > 0).double() * self.believed.arena.dt
        increments = self._increments(observation, dt)
        tracks, motion = odometry.exchange(self.group, belief.tracks, increments, dt, linked)
        new = windows.observed_matches(self.poses, observation, linked, self.broadcast)
        window = self._remembered(belief.window, motion, dt, new)
        origin = torch.where(linked[..., :1], observation["reference"].double(), belief.origin)
        scale, active = self._scale(belief), links & links.mT
        targets = self._targets(window, scale, shape[1], active)
        x = self._predict(belief, motion, dt)
        edges = self._edges(belief, motion, dt)
        started = belief.started
        for target in targets:
            x, estimate, edges, started = self._iterate(x, edges, started, active, target)
        inliers = target.inliers(estimate)
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
        return after, self.world_estimate(
            estimate[:, own, own, : self.poses.size],
            target.position_covariance(estimate, inliers),
            origin,
            self._speed(belief, after, observation, dt),
        )

    def team(self, belief: SteinBelief) -> Float[Tensor, "B H N P"]:
        return belief.estimate[..., : self.poses.size]

    def diagnostics(self, belief: SteinBelief) -> dict[str, Float[Tensor, "B N"]]:
        return {"inlier_share": belief.inliers}

    def _nothing(self, shape: torch.Size, like: Tensor) -> MatchWindow:
        """A window before any match."""
        return windows.empty(self.poses, shape, self.window, like)

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

    def _increments(
        self, observation: Observation, dt: Float64[Tensor, "B N"]
    ) -> Float64[Tensor, "B N P"]:
        """Each UAV's own motion in a step of ``dt`` s."""
        return odometry.increments(self.poses, observation, dt)

    def _edges(
        self, belief: SteinBelief, motion: Motion, dt: Float64[Tensor, "B H"]
    ) -> Float64[Tensor, "B H R N P"]:
        """The dual variables, which move as the UAVs do."""
        return odometry.propagate(self.poses, belief.edges, motion.moved.unsqueeze(2))

    def _remembered(
        self, window: MatchWindow, motion: Motion, dt: Float64[Tensor, "B H"], new: Matches
    ) -> MatchWindow:
        """The window's matches as they are now, and the ``new`` ones."""
        std = (self.std[0], self.std[-1])
        return windows.insert(windows.propagate(self.poses, window, motion.moved, std), new)

    def _targets(
        self, window: MatchWindow, scale: Scale, agents: int, active: Bool[Tensor, "B H R"]
    ) -> Sequence[Target]:
        """Each iteration's."""
        target = MatchTarget(
            poses=self.poses,
            window=window,
            factors=factors(self.poses, window, scale, agents),
            scale=scale,
            beta=outlier_level(self.poses, scale, self.outliers, self.volume),
            active=active,
            uniform=tuple(self.uniform),
            pull=self.pull,
            across=self.across,
            literal=self.literal,
        )
        return [target] * self.iterations

    def _speed(
        self,
        before: SteinBelief,
        after: SteinBelief,
        observation: Observation,
        dt: Float64[Tensor, "B N"],
    ) -> Float64[Tensor, "B N d"]:
        """Each UAV's velocity in its own body frame, m/s."""
        return odometry.speed(self.poses, observation, dt > 0)

    def _drawn(self, belief: SteinBelief, size: int) -> Float64[Tensor, "B H m N D"]:
        """Standard normal numbers for ``size`` errors of each agent's motion in each particle."""
        n, key = belief.step.shape[1], noise.fold(belief.key, belief.step)
        draws = normal(key, "cspf.step", n * size, self.particles).double()
        return draws.unflatten(-1, (n, -1))

    def _predict(
        self, belief: SteinBelief, motion: Motion, dt: Float64[Tensor, "B H"]
    ) -> Float64[Tensor, "B H N m P"]:
        """x_j ← D_0⁻¹ x_j D_j (equation 29), each particle with noise of its own on every D; a
        single one without noise."""
        d = motion.moved.unsqueeze(2)
        if self.particles > 1 and any(self.std):
            draws = self._drawn(belief, self.poses.dof)
            draws = draws * draws.new_tensor(self.std)
            spread = motion.steps.to(torch.float32).sqrt()[:, :, None, :, None]
            d = self.poses.plus(d, draws * spread)
        return odometry.propagate(self.poses, belief.x.transpose(2, 3), d).transpose(2, 3)

    def _iterate(
        self,
        x: Float64[Tensor, "B H N m P"],
        edges: Float64[Tensor, "B H R N P"],
        started: Bool[Tensor, "B H R"],
        linked: Bool[Tensor, "B H R"],
        target: Target,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Lines 7 to 9 of Algorithm 1: particles by equation 26, MAP estimate, dual variables by
        equation 21; ``linked``: edges in both directions."""
        active = started & started.mT & linked
        received = edges.transpose(1, 2)
        found = target.direction(x, received, active)
        moved = self.states.plus(x, self.pace * found.phi)  # x exp(a φ*), eq. 15
        x = torch.cat((x[:, :, :1], moved[:, :, 1:]), 2)
        estimate = map_estimate(self.states, x, found.log_density, found.k)
        if self.consensus:
            updated = consensus.dual_update(self.states, edges, received, estimate, self.eta)
            first = linked & ~started
            edges = torch.where(active[..., None, None], updated, edges)
            edges = torch.where(first[..., None, None], estimate.unsqueeze(2), edges)
        return x, estimate, edges, started | linked
