"""How well a team will know its positions, if it goes where it plans to: no measurement is drawn,
variances follow from where UAVs will be (an EKF's recursion about the planned path)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from agents.tasks.task import NOISE, Task
from coloc_env.sensors import Displacement


@dataclass(frozen=True)
class Outlook:
    """Positions (m), velocities (m/s) and the joint covariance (m²) of M planned teams."""

    position: Float[Tensor, "M N d"]
    velocity: Float[Tensor, "M N d"]
    covariance: Float[Tensor, "M N*d N*d"]

    @property
    def sigma(self) -> Float[Tensor, "M N"]:
        """Root of each position's variance, all axes together (m)."""
        variances = self.covariance.diagonal(dim1=-2, dim2=-1)
        return variances.unflatten(-1, self.position.shape[1:]).sum(-1).clamp_min(0.0).sqrt()


class Predictor:
    """Steps ``Outlook``s on: those that act take velocities, the others go on as they do."""

    def __init__(self, task: Task) -> None:
        self.task = task
        n, total, a = task.n_agents, task.believed.arena.n_uavs, len(task.anchors)
        free = total - task.scenario.targets  # the last so many do not range each other, or anchors
        i, j = torch.triu_indices(total, total, 1)
        if task.scenario.strangers:
            met = (i >= n) | (j >= n)
            i, j = i[met], j[met]
        i, j = i[i < free], j[i < free]
        row = torch.arange(free * a)
        ends = torch.zeros(len(i) + len(row), total)
        ends[torch.arange(len(i)), i] = 1.0
        ends[torch.arange(len(i)), j] -= 1.0
        ends[len(i) + row, row // max(a, 1)] = 1.0
        self.ends = ends  # of each range, +1 at one UAV, −1 at the other
        fixed = torch.zeros(len(ends), task.dim)
        if a:
            fixed[len(i) :] = task.anchors[row % a]
        self.fixed = fixed
        sensor = task.believed.sensor(Displacement)
        assert sensor is not None
        self.odometry, self.eye = sensor, torch.eye(total * task.dim)
        self.a_max = task.a_max

    def start(
        self,
        position: Float[Tensor, "M N d"],
        velocity: Float[Tensor, "M N d"],
        joint: Float[Tensor, "M N N d d"],
    ) -> Outlook:
        size = self.eye.shape[0]
        moving = velocity.clone()
        if self.task.scenario.targets:  # whose motion is a random walk
            moving[:, -self.task.scenario.targets :] = 0.0
        return Outlook(position, moving, joint.transpose(2, 3).reshape(-1, size, size))

    def step(self, now: Outlook, wanted: Float[Tensor, "M n d"]) -> Outlook:
        """A step of dt, with velocities (m/s) that are wanted of those that act."""
        n, dt, task = self.task.n_agents, self.task.scenario.arena.dt, self.task
        change = wanted - now.velocity[:, :n]
        length = change.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        faster = now.velocity[:, :n] + change * (self.a_max * dt / length).clamp(max=1.0)
        velocity = torch.cat((faster, now.velocity[:, n:]), 1)
        way = 0.5 * dt * (now.velocity + velocity)
        position = torch.minimum(torch.maximum(now.position + way, task.low), task.high)
        added = self.odometry.variance(way.norm(dim=-1))  # Q = s₀² + s₁² · distance
        p = now.covariance + torch.diag_embed(added.repeat_interleave(task.dim, -1))
        return Outlook(position, velocity, self._updated(position, p))

    def _updated(
        self, position: Float[Tensor, "M N d"], p: Float[Tensor, "M D D"]
    ) -> Float[Tensor, "M D D"]:
        """P⁺ = (I + P Λ)⁻¹ P, with all ranges that are in reach, expanded to the second order."""
        total, d = position.shape[1:]
        apart = self.ends @ position - self.fixed  # [M, K, d]
        distance = apart.norm(dim=-1).clamp_min(1.0)
        unit = apart / distance.unsqueeze(-1)
        h = (self.ends.unsqueeze(-1) * unit.unsqueeze(-2)).flatten(-2)  # [M, K, N·d]
        along = ((h @ p) * h).sum(-1)
        traces = p.unflatten(-1, (total, d)).unflatten(1, (total, d))
        traces = traces.diagonal(dim1=2, dim2=4).sum(-1)  # [M, N, N]: tr P_ij
        whole = ((self.ends @ traces) * self.ends).sum(-1)
        across = (whole - along).clamp_min(0.0)
        noise = (NOISE.std + NOISE.per_metre * distance) ** 2 + 0.5 * (across / distance) ** 2
        weight = (distance <= self.task.radius) / noise
        information = h.mT @ (h * weight.unsqueeze(-1))
        updated = torch.linalg.solve(self.eye + p @ information, p)
        return 0.5 * (updated + updated.mT)
