"""The base of localizers of relative poses: beliefs, initial poses, and world estimates."""

import math
from typing import ClassVar, TypeVar

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from agents.errors import NotServed
from agents.localizer import Estimate, Localizer
from agents.particle.belief import normal, uniform
from agents.stein.likelihood import Scale
from agents.tensorclasses import build
from coloc_env.geometry import poses_in, rotate, rotation_matrix
from coloc_env.scenario import Believed
from coloc_env.sensors import Odometry, Reference, RelativePose, Sensor

_START = (5.0, 0.5 * math.pi)  # m, rad: initial standard deviations of matches
_KNOWN = 1e-6  # m²: variance of the position of UAV 0, which is the reference

B = TypeVar("B")


class RelativeTeam(Localizer[B]):
    """Base of localizers of teams that measure relative poses; ``outliers``: share of them that is
    believed to be wrong, uniform over the arena and all rotations. ValueError without such a
    sensor, without odometry (or what else they are ``moved_by``), or in a team with more UAVs than
    slots."""

    serves: ClassVar[tuple[type[Sensor], ...]] = (RelativePose, Odometry)
    moved_by: ClassVar[type[Sensor]] = Odometry

    def __init__(self, believed: Believed, outliers: float, anneal: float) -> None:
        super().__init__(believed)
        arena = believed.arena
        matches, moved_by = believed.sensor(RelativePose), believed.sensor(self.moved_by)
        if matches is None or moved_by is None or believed.sensor(Reference) is None:
            words = self.moved_by.__name__.lower()
            raise NotServed(f"a team with relative poses, {words} and a reference is needed")
        if believed.slots < arena.n_uavs:
            raise NotServed(f"a team of {arena.n_uavs} needs as many slots, not {believed.slots}")
        self.poses, self.matches = poses_in(arena.dim), matches
        self.outliers, self.anneal = outliers, anneal
        sides = [b - a for a, b in zip(arena.low, arena.high, strict=True)]
        turns = self.poses.dof - arena.dim
        self.volume = math.prod(sides) * (8 * math.pi**2 if turns == 3 else 2 * math.pi)
        self.uniform = [s * s / 12 for s in sides] + [math.pi**2 / 3] * turns
        self.std = [size * arena.dt for size in self._noise_of(moved_by)]

    def _noise_of(self, sensor: Sensor) -> list[float]:
        """Standard deviations of what UAVs are moved by, along each tangent."""
        assert isinstance(sensor, Odometry)
        return sensor.std(torch.zeros(self.poses.dof, dtype=torch.float64)).tolist()

    @property
    def exchanges(self) -> bool:
        return True

    def scale(self, annealed: Int64[Tensor, "B H"]) -> Scale:
        """Standard deviations of matches after t steps of annealing: max(σ_p, 5 ρᵗ m) and
        max(σ_r, ½π ρᵗ)."""
        factor = self.anneal ** annealed.double()
        return Scale(
            (_START[0] * factor).clamp_min(self.matches.std),
            (_START[1] * factor).clamp_min(self.matches.turn_std),
        )

    def uniform_poses(
        self, key: Int64[Tensor, "B H"], origin: Float64[Tensor, "B H P"], agents: int, count: int
    ) -> Float64[Tensor, "B H A m P"]:
        """Poses uniform in the arena and over all rotations, relative to ``origin``."""
        poses, arena = self.poses, self.believed.arena
        d, a = arena.dim, agents
        low = origin.new_tensor(arena.low)
        place = uniform(key, "stein.place", a * d, count).double().unflatten(-1, (a, d))
        place = low + (origin.new_tensor(arena.high) - low) * place
        if d == 3:
            turn = normal(key, "stein.turn", 4 * a, count).double().unflatten(-1, (a, 4))
            turn = turn / turn.square().sum(-1, keepdim=True).sqrt()
        else:
            turn = math.pi * (2 * uniform(key, "stein.turn", a, count).double() - 1)
            turn = turn.unsqueeze(-1)
        x = poses.between(origin[:, :, None, None], torch.cat((place, turn), -1))
        return x.transpose(2, 3)

    def world_estimate(
        self,
        own: Float64[Tensor, "B N P"],
        covariance: Float64[Tensor, "B N d d"],
        origin: Float64[Tensor, "B N P"],
        speed: Float64[Tensor, "B N d"],
    ) -> Estimate:
        """Each UAV's estimate of itself (relative to UAV 0, at ``origin``; covariance and velocity
        ``speed``, m/s, in its own body frame) in the world frame."""
        world = self.poses.compose(origin, own)
        position, attitude = self.poses.split(world)
        rotation = rotation_matrix(attitude)
        covariance = rotation @ covariance @ rotation.mT
        covariance = 0.5 * (covariance + covariance.mT)
        eye = torch.eye(self.poses.dim, dtype=covariance.dtype, device=covariance.device)
        first = (torch.arange(covariance.shape[1], device=covariance.device) == 0)[:, None, None]
        return build(
            Estimate,
            own.shape[:2],
            position=position,
            velocity=rotate(attitude, speed),
            covariance=torch.where(first, _KNOWN * eye, covariance),
        )
