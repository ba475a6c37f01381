"""Collaborative Stein particle filter (Arita & Namerikawa): Stein particles that agree with each
other by relaxed ADMM.

Every UAV holds m particles, each a joint guess of the whole team's poses relative to UAV 0 (eq.
14). Stein variational gradient descent with Gauss–Newton targets moves them (eqs. 15–17), consensus
variables on the edges draw the holders together (eq. 21). ``../shared/specs/cspf.md`` says which
readings of the paper are followed, and why.
"""

import math

import torch
from jaxtyping import Bool, Float, Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.localizer import Estimate, Localizer, register
from agents.particles.belief import normal, own_keys, uniform
from agents.stein import consensus, reckoning
from agents.stein import window as windows
from agents.stein.estimate import covariance, map_estimate
from agents.stein.likelihood import Factors, Scale, factors, fit, outlier_level
from agents.stein.reckoning import Tracks
from agents.stein.update import kernel, stein_step
from agents.stein.window import Window
from agents.tensorclasses import build
from coloc_env import noise
from coloc_env.geometry import poses_in, rotate, rotation_matrix
from coloc_env.observation import Observation
from coloc_env.scenario import Believed
from coloc_env.sensors import Odometry, RelativePose

_START = (5.0, 0.5 * math.pi)  # m, rad: what matches count with at first
_KNOWN = 1e-6  # m²: variance of UAV 0's position, which is where it is by definition


class SteinBelief(TensorClass):
    """Particles and estimate of each holder, its edges' variables (``started``: which hold
    something), what it remembers of matches and tracks, UAV 0's pose in the world when it was last
    heard, the annealing's age in steps, its key and steps taken; batch (B, H)."""

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


@register("cspf")
class SteinFilter(Localizer[SteinBelief]):
    """Stein particles of the team's poses, one cloud a UAV, that agree by consensus.

    ``particles`` a UAV, ``iterations`` a step, ``window``: matches remembered. ``gamma``, ``eta``:
    penalty and step of the consensus; ``repulsion`` and ``pace`` of the Stein step; ``anneal``: by
    what factor the scale of matches shrinks in a step; ``outliers``: share of wrong matches
    believed. ``broadcast=true`` tells every match to all that hear its first end.
    """

    name = "cspf"

    def __init__(
        self,
        believed: Believed,
        *,
        particles: int = 50,
        iterations: int = 2,
        window: int = 30,
        gamma: float = 0.1,
        eta: float = 1.0,
        repulsion: float = 0.1,
        pace: float = 0.5,
        anneal: float = 0.96,
        outliers: float = 0.2,
        consensus: bool = True,
        broadcast: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__(believed)
        arena = believed.arena
        matches, odometry = believed.sensor(RelativePose), believed.sensor(Odometry)
        if matches is None or odometry is None:
            raise ValueError("a team with relative poses and odometry is needed")
        if believed.slots < arena.n_uavs:
            raise ValueError(f"a team of {arena.n_uavs} needs as many slots, not {believed.slots}")
        self.poses, self.matches, self.odometry = poses_in(arena.dim), matches, odometry
        self.particles, self.iterations, self.window = particles, iterations, window
        self.gamma, self.eta, self.repulsion, self.pace = gamma, eta, repulsion, pace
        self.anneal, self.outliers = anneal, outliers
        self.consensus, self.broadcast, self.seed = consensus, broadcast, seed
        sides = [b - a for a, b in zip(arena.low, arena.high, strict=True)]
        turns = 8 * math.pi**2 if arena.dim == 3 else 2 * math.pi
        self._parts = torch.tensor((arena.dim, self.poses.dof - arena.dim))
        self.volume = math.prod(sides) * turns
        self._spread = [s * s / 12 for s in sides] + [math.pi**2 / 3] * (3 if arena.dim == 3 else 1)

    @property
    def exchanges(self) -> bool:
        return True

    def reset(self, observation: Observation) -> SteinBelief:
        key = own_keys(observation, self.seed)
        b, n = key.shape
        poses = self.poses
        origin = observation["reference"].double()
        like = origin
        x = self._anywhere(key, origin)
        estimate = x[..., 0, :].contiguous()
        return SteinBelief(
            x=x,
            estimate=estimate,
            edges=estimate.unsqueeze(2).expand(-1, -1, n, -1, -1).contiguous(),
            started=torch.zeros(b, n, n, dtype=torch.bool, device=key.device),
            window=windows.empty(poses, key.shape, self.window, like),
            tracks=reckoning.begun(poses, key.shape, like),
            origin=origin,
            annealed=torch.zeros_like(key),
            inliers=torch.ones_like(origin[..., 0]),
            key=key,
            step=torch.zeros_like(key),
            batch_size=key.shape,
        )

    def step(self, belief: SteinBelief, observation: Observation) -> tuple[SteinBelief, Estimate]:
        poses, n = self.poses, belief.step.shape[1]
        heard = observation["links"] > 0
        known = heard | torch.eye(n, dtype=torch.bool, device=heard.device)
        dt = (belief.step > 0) * self.believed.arena.dt * torch.ones_like(belief.inliers)
        tracks, moves = reckoning.told(poses, belief.tracks, observation, dt, known)
        std = reckoning.deviations(poses, self.odometry, self.believed.arena.dt, belief.inliers)
        x = self._predicted(belief, moves, std)
        edges = reckoning.carried(poses, belief.edges, moves.step.unsqueeze(2))
        window = windows.moved(poses, belief.window, moves.step, (float(std[0]), float(std[-1])))
        window = windows.stored(window, windows.matches(poses, observation, known, self.broadcast))
        origin = torch.where(known[..., :1], observation["reference"].double(), belief.origin)
        scale = self._scale(belief.annealed)
        known_factors = factors(poses, window, scale, n)
        beta = outlier_level(poses, scale, self.outliers, self.volume)
        talking = heard & heard.mT
        started = belief.started & talking
        for _ in range(self.iterations):
            told = edges.transpose(1, 2)
            active = started & started.mT
            now = fit(poses, x, window, known_factors, scale, beta)
            if self.consensus:
                toward = consensus.pulls(poses, x, told, active)
                pull = self.gamma * toward.sum(2)
                density = now.log_density - 0.5 * self.gamma * self._squares(toward, scale)
            else:
                pull, density = torch.zeros_like(now.steps), now.log_density
            den = now.weight + self.gamma * (n - 1)
            near = kernel(poses, x, scale)
            both = den.repeat_interleave(self._parts, -1)
            phi = stein_step(
                near,
                ((now.steps + pull) / both).transpose(2, 3),
                den.transpose(2, 3),
                self.repulsion,
            )
            phi = self.pace * phi.transpose(2, 3)
            phi[:, :, 0] = 0.0
            x = poses.plus(x, phi)
            estimate = map_estimate(poses, x, density, near.k)
            if self.consensus:
                fresh = estimate.unsqueeze(2).expand_as(edges)
                moved = consensus.agreed(poses, edges, told, estimate, self.eta)
                edges = torch.where(
                    active[..., None, None],
                    moved,
                    torch.where(started[..., None, None], edges, fresh),
                )
                started = started | talking
        last = fit(poses, estimate.unsqueeze(-2), window, known_factors, scale, beta).inliers[
            ..., 0
        ]
        share = last.sum(-1) / window.held.sum(-1).clamp_min(1)
        after = build(
            SteinBelief,
            key_shape := belief.step.shape,
            x=x,
            estimate=estimate,
            edges=edges,
            started=belief.started | started,
            window=window,
            tracks=tracks,
            origin=origin,
            annealed=belief.annealed + 1,
            inliers=share,
            key=belief.key,
            step=belief.step + 1,
        )
        del key_shape
        return after, self._estimate(after, observation, last, known_factors, scale, dt)

    def team(self, belief: SteinBelief) -> Float[Tensor, "B H N P"]:
        return belief.estimate

    def diagnostics(self, belief: SteinBelief) -> dict[str, Float[Tensor, "B N"]]:
        return {"inlier_share": belief.inliers}

    def _scale(self, annealed: Int64[Tensor, "B H"]) -> Scale:
        factor = self.anneal ** annealed.double()
        return Scale(
            (_START[0] * factor).clamp_min(self.matches.std),
            (_START[1] * factor).clamp_min(self.matches.turn_std),
        )

    def _squares(self, tangent: Float64[Tensor, "B H R N m D"], scale: Scale) -> Tensor:
        squares = tangent.square()
        d = self.poses.dim
        one = scale.position.square()[..., None], scale.turn.square()[..., None]
        return squares[..., :d].sum((2, 3, 5)) / one[0] + squares[..., d:].sum((2, 3, 5)) / one[1]

    def _predicted(
        self, belief: SteinBelief, moves: reckoning.Moves, std: Float64[Tensor, "D"]
    ) -> Float64[Tensor, "B H N m P"]:
        """D_0⁻¹ x D_j with each particle's own noise on every D."""
        poses, (_, n) = self.poses, belief.step.shape
        x = belief.x.transpose(2, 3)
        step = moves.step.unsqueeze(2)
        if self.particles > 1:
            key = noise.fold(belief.key, belief.step)
            draws = normal(key, "cspf.step", n * poses.dof, self.particles).double()
            draws = draws.unflatten(-1, (n, -1)) * std
            step = poses.plus(step, draws * moves.steps.sqrt()[:, :, None, :, None])
        return reckoning.carried(poses, x, step).transpose(2, 3)

    def _anywhere(
        self, key: Int64[Tensor, "B H"], origin: Float64[Tensor, "B H P"]
    ) -> Float64[Tensor, "B H N m P"]:
        """Poses uniform in the arena and over all rotations, relative to UAV 0's."""
        poses, arena, m = self.poses, self.believed.arena, self.particles
        n, d = arena.n_uavs, arena.dim
        low = origin.new_tensor(arena.low)
        place = uniform(key, "cspf.place", n * d, m).double().unflatten(-1, (n, d))
        place = low + (origin.new_tensor(arena.high) - low) * place
        if d == 3:
            turn = normal(key, "cspf.turn", 4 * n, m).double().unflatten(-1, (n, 4))
            turn = turn / turn.norm(dim=-1, keepdim=True)
        else:
            turn = math.pi * (2 * uniform(key, "cspf.turn", n, m).double().unsqueeze(-1) - 1)
        x = poses.between(origin[:, :, None, None], torch.cat((place, turn), -1)).transpose(2, 3)
        x[:, :, 0] = poses.identity(x)
        return x

    def _estimate(
        self,
        belief: SteinBelief,
        observation: Observation,
        inliers: Float64[Tensor, "B H W"],
        known: Factors,
        scale: Scale,
        dt: Float64[Tensor, "B H"],
    ) -> Estimate:
        poses, n = self.poses, belief.step.shape[1]
        holder = torch.arange(n, device=belief.step.device)
        own = belief.estimate[:, holder, holder]
        world = poses.compose(belief.origin, own)
        position, attitude = poses.split(world)
        prior = position.new_tensor(self._spread)
        joint = covariance(poses, belief.estimate, belief.window, inliers, known, scale, prior)
        blocks = joint.unflatten(-1, (n, -1)).unflatten(2, (n, -1))
        block = blocks[:, holder, holder, :, holder].movedim(0, 1)[..., : poses.dim, : poses.dim]
        rotation = rotation_matrix(attitude)
        spread = rotation @ block @ rotation.mT
        spread = 0.5 * (spread + spread.mT)
        eye = torch.eye(poses.dim, dtype=spread.dtype, device=spread.device)
        spread = torch.where((holder == 0)[:, None, None], _KNOWN * eye, spread)
        speed = observation["odometry"][..., : poses.dim].double()
        velocity = torch.where(dt.unsqueeze(-1) > 0, rotate(attitude, speed), 0.0)
        return build(
            Estimate,
            belief.step.shape,
            position=position,
            velocity=velocity,
            covariance=spread,
        )
