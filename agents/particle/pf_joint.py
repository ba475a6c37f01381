"""One bootstrap particle filter over a whole team's relative poses (Gordon, Salmond & Smith 1993):
what the collaborative Stein particle filter is measured against."""

from typing import Annotated

import torch
from jaxtyping import Float, Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.localizer import Estimate
from agents.particle.belief import normal, own_keys
from agents.particle.cloud import effective_sample_size, systematic
from agents.stein import match_window as windows
from agents.stein import odometry
from agents.stein.likelihood import Scale, factors, outlier_level, residuals
from agents.stein.team import RelativeTeam
from agents.tensorclasses import build
from coloc_env import noise
from coloc_env.observation import Observation
from coloc_env.options import Count, OpenShare, Quantity
from coloc_env.scenario import Believed

_ROUGH = 0.2  # of the annealed scale: what resampled particles are moved by


class TeamCloud(TensorClass):
    """Each UAV's pose relative to UAV 0 in every particle, the particles' log-weights (the same for
    all UAVs), the estimate, and random keys; batch (B, N)."""

    x: Float64[Tensor, "B N m P"]
    log_weights: Float64[Tensor, "B N m"]
    estimate: Float64[Tensor, "B N P"]
    ess_share: Float64[Tensor, "B N"]
    key: Int64[Tensor, "B N"]
    step: Int64[Tensor, "B N"]


class TeamParticleFilter(RelativeTeam[TeamCloud]):
    """Bootstrap filter of the team's joint poses, which sees every match, whatever the network.

    ``anneal``: by what factor the scale of matches shrinks in a step, from 5 m and a quarter turn
    on; resampled particles are then roughened by a fifth of that scale. 0 (default): no annealing,
    and no roughening but the odometry's noise. ``outliers``: share of wrong matches believed.
    """

    name = "pf_joint"
    centralized = True

    def __init__(
        self,
        believed: Believed,
        *,
        particles: Annotated[int, Quantity("", 2, 100_000)] = 150,
        anneal: Annotated[float, Quantity("", 0.0, below=1.0)] = 0.0,
        outliers: OpenShare = 0.2,
        seed: Count = 0,
    ) -> None:
        super().__init__(believed, outliers, anneal or 1.0)
        self.particles, self.annealing, self.seed = particles, anneal > 0, seed

    def reset(self, observation: Observation) -> TeamCloud:
        key, origin = own_keys(observation, self.seed), observation["reference"].double()
        x = self.uniform_poses(key, origin, 1, self.particles)[:, :, 0]
        first = torch.arange(key.shape[1], device=key.device) == 0
        x = torch.where(first[:, None, None], self.poses.identity(x), x)
        return TeamCloud(
            x=x,
            log_weights=torch.zeros_like(x[..., 0]),
            estimate=x[:, :, 0].contiguous(),
            ess_share=torch.ones_like(origin[..., 0]),
            key=key,
            step=torch.zeros_like(key),
            batch_size=key.shape,
        )

    def step(self, belief: TeamCloud, observation: Observation) -> tuple[TeamCloud, Estimate]:
        poses, n = self.poses, belief.step.shape[1]
        key = noise.fold(belief.key, belief.step)
        dt = (belief.step > 0).double() * self.believed.arena.dt
        moved = odometry.increments(poses, observation, dt).unsqueeze(2)
        spread = (belief.step > 0)[..., None, None] * self._draws(key, "pf_joint.step", self.std)
        moved = poses.plus(moved, spread)
        x = odometry.propagate(poses, belief.x.transpose(1, 2), moved.transpose(1, 2))
        scale = self._scale(belief.step[:, :1])
        log_weights = belief.log_weights + self._log_likelihood(x, observation, scale)
        log_weights = log_weights.log_softmax(-1)
        x = x.transpose(1, 2)
        estimate, spread = self._moments(x, log_weights)
        ess = effective_sample_size(log_weights)
        few = (ess < 0.5 * self.particles).unsqueeze(-1)
        ancestors = systematic(log_weights[:, :1].exp(), noise.unit(key[:, :1]))
        fresh = x.gather(2, ancestors.unsqueeze(-1).expand(-1, n, -1, poses.size))
        if self.annealing:
            turns = poses.dof - poses.dim
            size = torch.stack((scale.position,) * poses.dim + (scale.turn,) * turns, -1)
            rough = (
                _ROUGH * size.unsqueeze(2) * self._draws(key, "pf_joint.rough", [1.0] * poses.dof)
            )
            rough = torch.where((torch.arange(n) == 0)[:, None, None], 0.0, rough)
            fresh = poses.plus(fresh, rough)
        after = build(
            TeamCloud,
            belief.step.shape,
            x=torch.where(few.unsqueeze(-1), fresh, x),
            log_weights=torch.where(few, 0.0, log_weights),
            estimate=estimate,
            ess_share=ess / self.particles,
            key=belief.key,
            step=belief.step + 1,
        )
        origin = observation["reference"].double()
        return after, self.world_estimate(
            estimate, spread, origin, odometry.speed(poses, observation, dt > 0)
        )

    def team(self, belief: TeamCloud) -> Float[Tensor, "B H N P"]:
        n = belief.step.shape[1]
        return belief.estimate.unsqueeze(1).expand(-1, n, -1, -1)

    def diagnostics(self, belief: TeamCloud) -> dict[str, Float[Tensor, "B N"]]:
        return {"ess_share": belief.ess_share}

    def _scale(self, step: Int64[Tensor, "B 1"]) -> Scale:
        if self.annealing:
            return self.scale(step)
        one = torch.ones_like(step, dtype=torch.float64)
        return Scale(self.matches.std * one, self.matches.turn_std * one)

    def _draws(self, key: Int64[Tensor, "B N"], stream: str, std: list[float]) -> Tensor:
        draws = normal(key, stream, self.poses.dof, self.particles).double()
        return draws * draws.new_tensor(std)

    def _log_likelihood(
        self, x: Float64[Tensor, "B m N P"], observation: Observation, scale: Scale
    ) -> Float64[Tensor, "B 1 m"]:
        """Of this step's matches, a mixture of Gaussian ones and uniform outliers."""
        poses, n = self.poses, x.shape[2]
        everyone = torch.ones_like(observation["links"][..., :n], dtype=torch.bool)
        new = windows.observed_matches(poses, observation, everyone, True)
        new = windows.Matches(*(part[:, :1] for part in vars(new).values()))
        empty = windows.empty(poses, new.mask.shape[:2], new.mask.shape[-1], x)
        window = windows.insert(empty, new)
        beta = outlier_level(poses, scale, self.outliers, self.volume)
        known = factors(poses, window, scale, n)
        return residuals(poses, x.transpose(1, 2).unsqueeze(1), window, known, scale, beta)[2]

    def _moments(
        self, x: Float64[Tensor, "B N m P"], log_weights: Float64[Tensor, "B N m"]
    ) -> tuple[Float64[Tensor, "B N P"], Float64[Tensor, "B N d d"]]:
        """Weighted intrinsic mean about the heaviest particle, and covariance of the position in
        its body frame."""
        poses, weight = self.poses, log_weights.exp().unsqueeze(-1)
        best = log_weights.argmax(-1)[..., None, None].expand(-1, -1, 1, poses.size)
        centre = x.gather(2, best)
        apart = poses.minus(x, centre)
        mean = (weight * apart).sum(2)
        rest = (apart - mean.unsqueeze(2))[..., : poses.dim]
        floor = torch.eye(poses.dim, dtype=x.dtype, device=x.device) * self.std[0] ** 2
        return poses.plus(centre[:, :, 0], mean), rest.mT @ (weight * rest) + floor
